"""Promises of `cell.measure.vision.stripe.planes`."""

import cv2
import numpy as np
import pytest

from cell.measure.vision.pictures import read_picture
from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.planes import as_picture, range_of, read_colours
from lab.bench.stripe.workshop import Scene, draw


@pytest.mark.parametrize(
    ("bits", "shift", "full"), [(10, 0, 1023), (12, 0, 4095), (12, 4, 65520), (14, 2, 65532), (16, 0, 65535)]
)
def test_the_range_is_taken_from_the_values(bits, shift, full):
    values = np.random.default_rng(0).integers(0, 1 << bits, (64, 64)).astype(np.uint16)
    values[0, :2] = (1 << bits) - 1, 1
    assert range_of(values << shift) == full
    assert as_picture(values << shift).saturated[0, 0]


def test_alpha_is_left_out_and_equal_channels_are_grey():
    image, centres = draw(Scene("Gaussian", 2.0), 1)
    rgba = np.dstack([image] * 3 + [np.full_like(image, 255)])
    np.testing.assert_array_equal(extract(rgba).centres, extract(image).centres)
    assert np.nanmax(np.abs(extract(rgba).centres - centres)) < 0.2


def test_an_unknown_laser_and_channels_are_named():
    with pytest.raises(ValueError, match="violet"):
        extract(np.zeros((64, 64), np.uint8), laser="violet")
    with pytest.raises(ValueError, match="2 channels"):
        extract(np.zeros((64, 64, 2), np.uint8))


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
