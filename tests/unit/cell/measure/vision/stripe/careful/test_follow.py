"""The colour in which a line stands out is found."""

import numpy as np

from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.planes import LaserChannel


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
