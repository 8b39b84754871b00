"""Sub-pixel centres of the laser stripe, one per image row (or column), with an honest standard deviation each.

`extract` is the way in, to all pictures; a centre is the likeliest one, which attains the bound
(docs/explanation/theory.md, section 5, with what other ways make of the same pictures). What it means in space is the
business of the geometry.

The stripe in pictures that stream by, such as a sweep's: what they have in common is measured in some of them.

Laser, lens and surface make the speckle, camera and exposure the noise, not the single picture: both are measured in
the first picture of every `BLOCK` and hold for the others of the block, which saves a third of the time.

Drawn stripes, to be read and let go: what is loaded or compiled on first use is so before anything waits."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.pictures import Dark, PictureRefused, Taken
from cell.measure.vision.stripe.careful.careful import read_carefully
from cell.measure.vision.stripe.careful.surroundings import widen_what_departs
from cell.measure.vision.stripe.ordinary.quick import DOUBLE, QuickVerdict, read_quickly, refuse_white
from cell.measure.vision.stripe.planes import FULL, LaserChannel, Picture, as_picture
from cell.measure.vision.stripe.profile import Array, Axis, Image, StripeProfile, StripeSettings

TRUSTED_SHARE = 0.98
KEPT_PX = 32
"""Of a picture that is kept: the stripe's flanks, and enough beside them to see what it lies on."""


def extract(
    image: Taken, dark: Dark | None = None, axis: Axis = "rows", settings: StripeSettings | None = None, *,
    like: StripeProfile | None = None, laser: LaserChannel | str = LaserChannel.AUTO,
) -> StripeProfile:  # fmt: skip
    """Stripe centres of an image (h, w), (h, w, 3) or (h, w, 4), one per row (or per column with axis "columns").

    8 or 16 bits, 10 to 14 of them at either end; colours red first; alpha is left out. `laser` names the channel to
    read, "auto" finds that in which the laser stands out. `dark` is a frame of the same view without the laser and is
    subtracted; its noise counts, and where it is bright it tells the surface's albedo. `like` is the profile of an
    earlier picture of the same scene, whose noise, speckle and profile hold for this one as far as it has them; None:
    they are measured, where the settings do not declare them. An ordinary grey 8-bit picture takes .5 ms; what is not
    ordinary is read carefully and takes a hundred times that. Raises ValueError for an image of another type, a dark
    frame of another size, an unknown laser, `PictureRefused` for a picture that is blinded.
    """
    settings = settings or StripeSettings()
    laser = LaserChannel(laser)
    _check(image, dark)
    if image.ndim != 2 or image.dtype != np.uint8:
        picture = as_picture(image, settings.saturation_dn)
        if not picture.plain:
            return _carefully(picture, dark, axis, settings=settings, laser=laser, like=like, starts=None)
        dark = None if dark is None else _whole(_same_range(dark, picture, settings))
        image = _whole(picture)
    profile, verdict = read_quickly(np.asarray(image, np.uint8), dark, axis, settings, like)
    widen_what_departs(profile.centres, profile.sigma)
    if verdict is QuickVerdict.ORDINARY:
        return profile
    starts = profile.centres if _trusted(profile) else None
    careful = _carefully(
        as_picture(image, settings.saturation_dn), dark, axis, settings=settings, laser=laser, like=like, starts=starts
    )
    # Clear peaks that make no line, such as those of a comb, are what they are.
    alone = verdict is QuickVerdict.UNMISTAKABLE and careful.valid.sum() < 0.5 * profile.valid.sum()
    return profile if alone else careful


def _trusted(profile: StripeProfile) -> bool:
    """True when the quick search found a line that needs no following: one piece, without a second."""
    rows = profile.rows
    if len(rows) < 0.9 * len(profile.centres) or float(np.nanmedian(profile.width)) > 5.0:
        return False
    smooth = np.abs(np.diff(profile.centres[rows])) < 3.0 * np.diff(rows)
    return bool(smooth.mean() > TRUSTED_SHARE and profile.double.mean() < 1 - TRUSTED_SHARE)


def _carefully(
    picture: Picture, dark: Dark | None, axis: Axis, settings: StripeSettings, laser: LaserChannel,
    like: StripeProfile | None, starts: Array | None,
) -> StripeProfile:  # fmt: skip
    refuse_white(picture.saturated)
    off = None if dark is None else _same_range(dark, picture, settings)
    if axis == "columns":
        picture, off = picture.turned(), None if off is None else off.turned()
    taught = like.learned if like is not None else None
    seen = read_carefully(picture, off, laser, settings=settings, like=taught, starts=starts)
    widen_what_departs(seen.centres, seen.sigma)
    assert seen.rival is not None
    return replace(seen, axis=axis, double=(np.nan_to_num(seen.rival) > DOUBLE) & seen.valid)


def subtracted(image: Taken, dark: Dark | None, settings: StripeSettings) -> tuple[Picture, Picture | None]:
    """A picture and the one without the laser, in the same DN. Raises ValueError as `extract` does."""
    _check(image, dark)
    picture = as_picture(image, settings.saturation_dn)
    return picture, None if dark is None else _same_range(dark, picture, settings)


def _same_range(dark: Dark, picture: Picture, settings: StripeSettings) -> Picture:
    """The dark frame in the DN of the picture; of numbers with a fraction, they are taken to be those of 8 bits."""
    if dark.dtype in (np.uint8, np.uint16):
        off = as_picture(dark, settings.saturation_dn, picture.full)
    else:
        value: NDArray[np.float32] = dark.astype(np.float32)
        off = Picture(value, value >= settings.saturation_dn, True, FULL)
    if off.coloured == picture.coloured:
        return off
    if picture.coloured:
        return Picture(
            np.repeat(off.value[:, :, None], 3, axis=2), np.repeat(off.saturated[:, :, None], 3, axis=2), False,
            off.full,
        )  # fmt: skip
    return Picture(off.value.mean(axis=2), np.asarray(off.saturated.any(axis=2)), False, off.full)


def _whole(grey: Picture) -> Image:
    """A grey picture in whole DN of 8 bits, saturated pixels at the end of the range."""
    return np.where(grey.saturated, 255, np.clip(np.rint(grey.value), 0, 254)).astype(np.uint8)


def _check(image: Taken, dark: Dark | None) -> None:
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise ValueError(
            f"the stripe needs an 8-bit or 16-bit image, grey or RGB, not {image.dtype} of shape {image.shape}"
        )
    if dark is not None and dark.shape[:2] != image.shape[:2]:
        raise ValueError(f"the dark frame is {dark.shape}, the image {image.shape}: take both with the same camera")
    if min(image.shape[:2]) < 32:
        raise ValueError(f"the image is {image.shape[1]}×{image.shape[0]} px; at least 32×32 are needed")


BLOCK = 16
"""Pictures for which what was measured holds: 1.6 mm of a sweep at .1 mm a profile."""


class StripeStream:
    """`extract` for one picture after the other of a stream, all of one size, with the stripe along rows."""

    def __init__(self) -> None:
        self.like: StripeProfile | None = None
        """What holds for the next picture; None where it is measured in it."""
        self._seen = 0

    def extract(self, image: Image) -> StripeProfile:
        """The profile of the next picture (h, w); raises what `extract` raises."""
        profile = extract(image, like=self.like)
        self._seen += 1
        # A block's first picture that shows too few lines, such as a covered one, says nothing of the others.
        told = profile.speckle is not None or profile.learned is not None
        self.like = None if self._seen % BLOCK == 0 else profile if told else replace(profile, noise=None)
        return profile


def around_stripe(image: Image, profile: StripeProfile, like: StripeProfile) -> Image:
    """The picture (h, w), black beyond `KEPT_PX` of its stripe: a sixth of its bytes. The picture itself where it would
    not give the same `profile` again, to the last bit, or was read carefully."""
    rows = profile.rows
    if not len(rows) or profile.rival is not None:
        return image
    middle = np.rint(np.interp(np.arange(len(image)), rows, profile.centres[rows])).astype(np.int16)[:, None]
    columns = np.arange(image.shape[1], dtype=np.int16)
    cut = image * ((columns >= middle - KEPT_PX) & (columns <= middle + KEPT_PX))
    try:
        again = extract(cut, like=like)
    except (PictureRefused, ValueError):
        return image
    names = ("centres", "sigma", "amplitude", "width", "saturated", "double")
    same = all(np.array_equal(getattr(again, name), getattr(profile, name), equal_nan=True) for name in names)
    same &= (again.rival, again.noise, again.speckle) == (None, profile.noise, profile.speckle)
    return cut if same else image


def drawn(height: int, width: int) -> Iterator[NDArray[np.uint8]]:
    """Two pictures (height, width): an ordinary one, and one whose stripe has a flat top, which is read carefully."""
    rows, columns = np.mgrid[:height, :width]
    away = columns - 0.5 * width - 4 * np.sin(rows / 40)
    grain = np.random.default_rng(0).normal(0.0, 2.0, away.shape)
    for stripe in (np.exp(-0.5 * (away / 2) ** 2), 1 / (1 + np.exp(2 * (np.abs(away) - 6)))):
        yield np.clip(12.5 + 140 * stripe + grain, 0, 255).astype(np.uint8)


def read_drawn() -> None:
    """Load the loops that read stripes; where they were not compiled yet, that takes some 20 s."""
    for picture in drawn(240, 320):
        extract(picture)
