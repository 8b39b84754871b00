"""What a page shows of a cloud: its points where they are, coloured by their deviation or their height."""

import base64

import numpy as np
import pytest

from cell.run.report.page.surface import MOST_POINTS, Scanned, map_picture, view_data

POINTS = np.random.default_rng(0).uniform([-35.0, -18.0, 2.0], [35.0, 18.0, 8.0], (40_000, 3))


@pytest.mark.parametrize("compared", [True, False])
def test_a_cloud_keeps_its_size_and_its_scale_ends_where_it_is_said(compared: bool):
    scan = Scanned(POINTS, 0.01 * POINTS[:, 0] if compared else None, "")
    view = view_data(scan, 0.2)
    assert (view["count"], view["total"]) == (MOST_POINTS, len(POINTS))
    assert (view["from"], view["to"]) == pytest.approx((-0.2, 0.2) if compared else (2.0, 8.0), abs=0.01)
    # What is drawn has the cloud's size: distances do not depend on where it is seen from.
    shown = view["step"] * np.frombuffer(base64.b64decode(view["points"]), "<i2").reshape(-1, 3)
    assert np.ptp(shown, axis=0) == pytest.approx(np.ptp(POINTS, axis=0), abs=0.05)
    shades = np.frombuffer(base64.b64decode(view["shades"]), np.uint8)
    value = np.clip(0.01 * shown[:, 0] / 0.4 + 0.5, 0.0, 1.0) if compared else shown[:, 2] / 6.0 + 0.5
    assert shades / 254 == pytest.approx(value, abs=0.01)
    assert map_picture(scan, 0.2).startswith(b"\x89PNG")
