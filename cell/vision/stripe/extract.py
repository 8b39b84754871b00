"""Sub-pixel centres of the laser stripe, one per image row (or column), with an honest standard deviation each.

`extract` is the way in, to all pictures and methods; weighted maximum likelihood is the default and the one that
attains the bound (docs/theory.md, section 5). What a centre means in space is the business of the geometry.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cell import compiled
from cell.vision.stripe.careful import read_carefully
from cell.vision.stripe.look import choose_mix
from cell.vision.stripe.neighbours import widen_what_departs
from cell.vision.stripe.planes import FULL, Picture, as_picture
from cell.vision.stripe.planes import Laser as Laser
from cell.vision.stripe.profile import Array as Array
from cell.vision.stripe.profile import Axis as Axis
from cell.vision.stripe.profile import Image as Image
from cell.vision.stripe.profile import Mark as Mark
from cell.vision.stripe.profile import Method as Method
from cell.vision.stripe.profile import StripeProfile as StripeProfile
from cell.vision.stripe.profile import StripeSettings as StripeSettings
from cell.vision.stripe.quick import Verdict, read_quickly, refuse_white
from cell.vision.stripe.rivals import DOUBLE

TRUSTED_SHARE = 0.98


def extract(
    image: Any,
    dark: NDArray[np.floating] | NDArray[np.uint8] | NDArray[np.uint16] | None = None,
    axis: Axis = "rows",
    settings: StripeSettings | None = None,
    *,
    method: Method | str = Method.MAXIMUM_LIKELIHOOD,
    engine: Literal["auto", "compiled", "numpy"] = "auto",
    like: StripeProfile | None = None,
    laser: Laser | str = Laser.AUTO,
) -> StripeProfile:
    """Stripe centres of an image (h, w), (h, w, 3) or (h, w, 4), one per row (or per column with axis "columns").

    8 or 16 bits, 10 to 14 of them at either end; colours red first; alpha is left out. `laser` names the channel to
    read, "auto" finds that in which the laser stands out. `dark` is a frame of the same view without the laser and is
    subtracted; its noise counts, and where it is bright it tells the surface's albedo. `engine` "numpy" does without
    the compiler, as "auto" does where there is none. `like` is the profile of an earlier picture of the same scene,
    whose noise, speckle and profile hold for this one as far as it has them; None: they are measured, where the
    settings do not declare them. An ordinary grey 8-bit picture takes .5 ms; what is not ordinary is read carefully
    and takes a hundred times that. Raises ValueError for an image of another type, a dark frame of another size, an
    unknown method or laser, `PictureRefused` for a picture that is blinded.
    """
    settings = settings or StripeSettings()
    method, laser = Method(method), Laser(laser)
    _check(image, dark)
    if engine == "compiled" and not compiled.AVAILABLE:
        raise ValueError('engine "compiled": numba is missing or switched off here; take "numpy" or "auto"')
    plain = image.ndim == 2 and image.dtype == np.uint8
    likelihood = method is Method.MAXIMUM_LIKELIHOOD
    if not plain:
        picture = as_picture(image, settings.saturation_dn)
        if not picture.plain and likelihood:
            return _carefully(picture, dark, axis, settings, laser, like, None)
        image, dark = _one_plane(picture, dark, laser, settings)
    quick = compiled.AVAILABLE and engine != "numpy"
    profile, verdict = read_quickly(image, dark, axis, settings, method, quick, like)
    if likelihood:
        widen_what_departs(profile.centres, profile.sigma)
    if verdict is Verdict.ORDINARY or not likelihood:
        return profile
    starts = profile.centres if _trusted(profile) else None
    careful = _carefully(as_picture(image, settings.saturation_dn), dark, axis, settings, laser, like, starts)
    # Clear peaks that make no line, such as those of a comb, are what they are.
    alone = verdict is Verdict.UNMISTAKABLE and careful.valid.sum() < 0.5 * profile.valid.sum()
    return profile if alone else careful


def _trusted(profile: StripeProfile) -> bool:
    """True when the quick search found a line that needs no following: one piece, without a second."""
    rows = profile.rows
    if len(rows) < 0.9 * len(profile.centres) or float(np.nanmedian(profile.width)) > 5.0:
        return False
    smooth = np.abs(np.diff(profile.centres[rows])) < 3.0 * np.diff(rows)
    return bool(smooth.mean() > TRUSTED_SHARE and profile.double.mean() < 1 - TRUSTED_SHARE)


def _carefully(
    picture: Picture, dark: Any, axis: Axis, settings: StripeSettings, laser: Laser, like: StripeProfile | None,
    starts: Array | None,
) -> StripeProfile:  # fmt: skip
    """The profile of a picture by the careful way."""
    refuse_white(picture.saturated)
    off = None if dark is None else _same_range(dark, picture, settings)
    if axis == "columns":
        picture, off = picture.turned(), None if off is None else off.turned()
    taught = like.learned if like is not None else None
    seen = read_carefully(picture, off, laser, settings, taught, starts)
    widen_what_departs(seen.centres, seen.sigma)
    double = np.nan_to_num(seen.rival) > DOUBLE
    return StripeProfile(
        axis, seen.centres, seen.sigma, seen.amplitude, seen.width, seen.saturated,
        double & np.isfinite(seen.centres), None, None, seen.rival, seen.misfit, seen.learned,
    )  # fmt: skip


def subtracted(image: Any, dark: Any, settings: StripeSettings) -> tuple[Picture, Picture | None]:
    """A picture and the one without the laser, in the same DN. Raises ValueError as `extract` does."""
    _check(image, dark)
    picture = as_picture(image, settings.saturation_dn)
    return picture, None if dark is None else _same_range(dark, picture, settings)


def _same_range(dark: Any, picture: Picture, settings: StripeSettings) -> Picture:
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
            np.repeat(off.value[:, :, None], 3, axis=2),
            np.repeat(off.saturated[:, :, None], 3, axis=2),
            False,
            off.full,
        )
    return Picture(off.value.mean(axis=2), np.asarray(off.saturated.any(axis=2)), False, off.full)


def _one_plane(picture: Picture, dark: Any, laser: Laser, settings: StripeSettings) -> tuple[Image, Any]:
    """The plane in which the laser stands out, and the dark frame's, in whole DN, for methods that take no other."""
    off = None if dark is None else _same_range(dark, picture, settings)
    mix = choose_mix(picture, off, laser)

    def whole(part: Picture) -> Image:
        value, usable = part.plane(mix)
        return np.where(usable, np.clip(np.rint(value), 0, 254), 255).astype(np.uint8)

    return whole(picture), None if off is None else whole(off)


def _check(image: Any, dark: Any) -> None:
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise ValueError(
            f"the stripe needs an 8-bit or 16-bit image, grey or RGB, not {image.dtype} of shape {image.shape}"
        )
    if dark is not None and dark.shape[:2] != image.shape[:2]:
        raise ValueError(f"the dark frame is {dark.shape}, the image {image.shape}: take both with the same camera")
    if min(image.shape[:2]) < 32:
        raise ValueError(f"the image is {image.shape[1]}×{image.shape[0]} px; at least 32×32 are needed")
