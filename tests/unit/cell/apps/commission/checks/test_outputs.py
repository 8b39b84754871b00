"""Promises of `cell.apps.commission.checks.outputs`."""

import numpy as np

from cell.apps.commission.checks.outputs import bright_rows


def test_a_stripe_is_seen_as_one_and_light_that_goes_on_everywhere_is_not():
    rng = np.random.default_rng(2)
    off = rng.normal(40.0, 3.0, (120, 200))
    line = off + 120.0 * np.exp(-0.5 * ((np.arange(200) - 90.0) / 2.0) ** 2)
    pictures = [np.clip(p, 0, 255).astype(np.uint8) for p in (off, line, off + 60.0, rng.normal(40.0, 3.0, (120, 200)))]
    assert (bright_rows(pictures[0], pictures[1]), bright_rows(pictures[0], pictures[2])) == (120, 0)
    assert bright_rows(pictures[0], pictures[3]) == 0
