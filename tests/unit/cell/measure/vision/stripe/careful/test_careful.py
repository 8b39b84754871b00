"""Promises of the stripe as workshops have it: other profiles, widths, texture, colour, depth, edges, second lines."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cell.measure.vision import LaserChannel, Mark, PictureRefused, read_colours, read_picture, read_stripe
from cell.measure.vision.stripe.careful.careful import Careful, fill_gaps
from cell.measure.vision.stripe.extract import StripeStream, extract
from lab.bench.stripe.workshop import Scene, draw

SHAPE = (384, 480)


def board(laser: float, seed: int, extra: float | np.ndarray = 0.0, ambient: float = 70.0):
    """A stripe (peak `laser` DN) across printed squares of albedo .3 and 1, blurred by the lens; the true centres."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    squares = (column * np.cos(0.5) + row * np.sin(0.5)) // 40 + (row * np.cos(0.5) - column * np.sin(0.5)) // 40
    centres = 240 + 0.13 * (np.arange(SHAPE[0]) - 192)
    stripe = laser * np.exp(-0.5 * ((column - centres[:, None]) / 1.7) ** 2)
    light = gaussian_filter(np.where(squares % 2 > 0, 1.0, 0.3) * (ambient + stripe) + extra, 1.0) + 5
    noisy = rng.poisson(light * 40) / 40 + rng.normal(0, 0.4, SHAPE)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), centres


def test_edges_of_the_albedo_are_marked_and_a_picture_without_the_laser_takes_them_away():
    image, centres = board(120, 1, ambient=0.0)
    profile = extract(image)
    error = profile.centres - centres
    edges = (profile.marks & Mark.ALBEDO_EDGE) > 0
    assert np.sqrt(np.nanmean(error[~edges] ** 2)) < 0.06 < 0.15 < np.sqrt(np.nanmean(error[edges] ** 2))
    lit, _ = board(120, 1)
    without, _ = board(0, 2)
    read = extract(lit, without)
    assert read.valid.mean() > 0.99
    assert np.sqrt(np.nanmean((read.centres - centres) ** 2)) < 0.13
    clear = read.marks == 0
    assert np.sqrt(np.mean((read.centres - centres)[clear] ** 2) / np.mean(read.sigma[clear] ** 2)) < 1.3


def test_a_second_line_is_marked_where_it_is_and_not_taken():
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    second = 70 * np.exp(-0.5 * ((column - 300) / 2.5) ** 2) * ((row > 120) & (row < 250))
    image, centres = board(120, 3, second, ambient=5.0)
    profile = extract(image)
    assert np.nanmax(np.abs(profile.centres - centres)) < 3.0
    marked = (profile.marks & Mark.SECOND_LINE) > 0
    assert marked[125:245].mean() > 0.95
    assert marked[:110].mean() < 0.05


def test_a_step_is_marked():
    image, _ = draw(Scene("Gaussian", 2.0), 4)
    image[200:] = np.roll(image[200:], 40, axis=1)
    stepped = np.flatnonzero(extract(image).marks & Mark.STEP)
    assert set(stepped) >= {199, 200}
    assert set(stepped) <= set(range(196, 204))


def test_scenery_that_is_brighter_than_the_laser_goes_with_the_picture_without_it():
    post = np.zeros(SHAPE)
    post[:, 400:403] = 90
    lit, centres = board(120, 1, post)
    without, _ = board(0, 2, post)
    assert ((extract(lit).marks & (Mark.SECOND_LINE | Mark.REFLECTION)) > 0).mean() > 0.9
    assert np.nanmax(np.abs(extract(lit, without).centres - centres)) < 1.0


def test_a_core_that_is_saturated_in_one_channel_is_read_in_another():
    rng = np.random.default_rng(0)
    column = np.arange(480)
    centres = 240 + 0.2 * np.arange(384)
    stripe = np.exp(-0.5 * ((column - centres[:, None]) / 2.0) ** 2)
    planes = [rng.poisson((8 + peak * stripe) * 40) / 40 for peak in (3000.0, 150.0, 20.0)]
    image = np.clip(np.round(np.stack(planes, axis=2)), 0, 255).astype(np.uint8)
    profile = extract(image)
    assert not profile.saturated.any()
    assert np.sqrt(np.nanmean((profile.centres - centres) ** 2)) < 0.02
    assert extract(image, laser=LaserChannel.RED).saturated.all()


def test_alpha_is_left_out_and_equal_channels_are_grey():
    image, centres = draw(Scene("Gaussian", 2.0), 1)
    rgba = np.dstack([image] * 3 + [np.full_like(image, 255)])
    np.testing.assert_array_equal(extract(rgba).centres, extract(image).centres)
    assert np.nanmax(np.abs(extract(rgba).centres - centres)) < 0.2


def test_a_jpeg_is_read_with_a_true_deviation(tmp_path):
    image, centres = draw(Scene("Gaussian", 2.0, camera="red"), 3)
    cv2.imwrite(str(tmp_path / "laser.jpg"), image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    profile = extract(read_colours(tmp_path / "laser.jpg"))
    error = profile.centres - centres
    assert profile.valid.mean() > 0.99
    assert 0.6 < np.sqrt(np.nanmean(profile.sigma**2) / np.nanmean((error - np.nanmedian(error)) ** 2)) < 1.6


def test_which_way_a_line_runs_is_found_and_a_picture_without_one_has_none():
    image, centres = draw(Scene("Gaussian", 2.0, camera="green"), 2)
    seen = read_stripe(np.ascontiguousarray(image.transpose(1, 0, 2)))
    assert seen is not None
    assert seen.axis == "columns"
    assert np.nanmax(np.abs(seen.centres - centres)) < 1.0
    noise = np.random.default_rng(0).normal(80, 6, (200, 300)).clip(0, 255).astype(np.uint8)
    assert read_stripe(noise) is None


def test_in_a_stream_the_profile_of_a_block_is_that_of_its_first_picture():
    pictures = [draw(Scene("flat top", 2.0), seed) for seed in range(3)]
    stream = StripeStream()
    profiles = [stream.extract(image) for image, _ in pictures]
    assert profiles[0].learned is not None
    assert profiles[1].learned is profiles[2].learned is profiles[0].learned
    for profile, (_, centres) in zip(profiles, pictures, strict=True):
        assert np.sqrt(np.mean((profile.centres - centres) ** 2)) < 0.021


def test_an_unknown_laser_and_channels_are_named():
    with pytest.raises(ValueError, match="violet"):
        extract(np.zeros((64, 64), np.uint8), laser="violet")
    with pytest.raises(ValueError, match="2 channels"):
        extract(np.zeros((64, 64, 2), np.uint8))


def test_a_faint_line_beside_another_is_refused_until_the_laser_stands_out():
    """A grey picture in which a fold of paper is as clear as the laser; in colour, or without the fold, it is sure."""
    row, column = np.mgrid[:240, :320]
    noise = np.random.default_rng(3).normal(0, 3, (240, 320, 3))
    laser = 10 * np.exp(-0.5 * ((column - 100 - 0.1 * row) / 2) ** 2)
    fold = 10 * np.exp(-0.5 * ((column - 220 + 0.1 * row) / 2) ** 2)
    colour = 60 + noise + fold[:, :, None] + laser[:, :, None] * (3.0, 0.0, 0.0)
    colour = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
    grey = np.clip(np.rint(60 + noise[:, :, 0] + fold + laser), 0, 255).astype(np.uint8)
    with pytest.raises(PictureRefused, match=r"which line is the laser's is not sure.*laser off"):
        read_stripe(grey)
    off = np.clip(np.rint(60 + noise[:, :, 1] + fold), 0, 255).astype(np.uint8)
    for seen in (read_stripe(colour), read_stripe(grey, off)):
        assert seen is not None
        assert np.nanmedian(np.abs(seen.centres - 100 - 0.1 * np.arange(240))) < 0.5


def test_colours_are_read_in_the_sensors_frame_whatever_the_picture_says(tmp_path):
    """A camera that stands on its side says so in the EXIF; its lens does not turn with it, nor does the search."""
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, :10, 2] = 200
    _, data = cv2.imencode(".jpg", image)
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data.tobytes()[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data.tobytes()[2:]
    (tmp_path / "side.jpg").write_bytes(turned)
    seen = read_colours(tmp_path / "side.jpg")
    assert seen.shape == (40, 60, 3) == (*read_picture(tmp_path / "side.jpg").shape, 3)
    assert seen[20, 5, 0] > 150 > 50 > seen[20, 40, 0]


def line_of(width: np.ndarray, seed: int, light: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A line whose rows are `width` (rows,) px wide, with `light` (rows,) times the usual; its true centres."""
    rng = np.random.default_rng(seed)
    row = np.arange(len(width))
    centres = 320 + 0.05 * (row - row.mean())
    height = 120 * light * np.sqrt(np.minimum(1.0, 2.0 / width))
    stripe = height[:, None] * np.exp(-0.5 * ((np.arange(640) - centres[:, None]) / width[:, None]) ** 2)
    noisy = rng.poisson((8 + stripe) * 40) / 40 + rng.normal(0, 0.4, stripe.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), centres


@pytest.mark.parametrize(
    "width",
    [np.linspace(1.5, 8, 480), np.linspace(2, 15, 480), np.repeat([1.0, 3.0, 9.0], 160)],
    ids=["1.5 to 8", "2 to 15", "1, 3, 9"],
)
def test_pieces_of_a_line_that_are_much_wider_or_narrower_than_the_rest_are_read(width):
    """Out of focus, on what shines: of these a tenth to a third was not found."""
    for seed in (1, 2):
        image, centres = line_of(width, seed)
        profile = extract(image)
        error = profile.centres - centres
        assert np.isfinite(error).mean() > 0.98
        assert np.nanmax(np.abs(error)) < 0.7
        for piece in np.array_split(np.arange(480), 3):
            score = np.sqrt(np.nanmean((error / profile.sigma)[piece] ** 2))
            assert 0.4 < score < 1.25, score


def careful(centres: np.ndarray, light: float = 240.0) -> Careful:
    """What the careful way found: a line 2 px wide."""
    seen = np.isfinite(centres)
    width, zero = np.where(seen, 2.0, np.nan), np.zeros(len(centres))
    return Careful(centres.copy(), 0.02 * width, 0.5 * light * width / 2, width, zero > 0, zero, width / 2, None)


@pytest.mark.parametrize(
    ("piece", "taken"),
    [
        (lambda on: careful(on), True),
        (lambda on: careful(on, 100.0), True),
        (lambda on: careful(on + 5.0), False),
        (lambda on: careful(on, 20.0), False),
        (lambda on: careful(np.where(np.arange(len(on)) % 3 > 0, on, np.nan)), False),
    ],
    ids=["the line", "a darker part of it", "beside it", "a reflection", "specks"],
)
def test_a_gap_of_a_line_is_filled_only_with_the_same_line(piece, taken):
    centres = 320 + 0.05 * np.arange(480)
    line = careful(np.where(np.arange(480) < 330, centres, np.nan))
    asked = []

    def read(rows: slice) -> Careful:
        asked.append(rows)
        return piece(centres[rows])

    fill_gaps(line, read)
    assert len(asked) == 1 and asked[0].start == pytest.approx(330, abs=6) and asked[0].stop == 480
    assert np.isfinite(line.centres[340:]).all() == taken
    assert np.isfinite(line.centres[:320]).all()


def test_where_little_of_a_picture_shows_a_line_nothing_is_added_to_it():
    line = careful(np.where(np.arange(480) < 140, 320.0, np.nan))
    fill_gaps(line, lambda rows: pytest.fail("read again"))
