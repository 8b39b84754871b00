"""The bench of jobs in the open: what it says of a row, and how far the line's centres scatter in the sun."""

from lab.bench.job.outdoor import configured, scatter, summed_up


def test_a_row_counts_what_was_placed_inside_and_refused_for_the_light():
    placed = {"outcome": "placed", "reason": "", "mean": 0.05, "largest": 0.1, "inside": True, "exposure": 2.0}
    dark = {"outcome": "refused", "reason": "ambient light reaches", "exposure": None}
    other = {"outcome": "refused", "reason": "no board", "exposure": 0.5}
    runs = [run | {"within_tolerance": within} for run, within in ((placed, True), (dark, None), (other, None))]
    row = summed_up(runs)
    assert row["figure"] == (
        "1 of 3 placed, mean D 0.050, largest 0.100 mm, 1 inside; exposure 0.50 to 2.00 ms; "
        "1 refused for ambient light, 1 otherwise"
    )
    assert row["wrong"] == 0 and summed_up([placed | {"within_tolerance": False}])["wrong"] == 1


def test_the_filter_is_described_and_keeps_the_line_s_centres_in_full_sun():
    assert configured(True).scan_camera.filter is not None and configured(False).scan_camera.filter is None
    behind, room = scatter(100, True)["px"], scatter(0, True)["px"]
    assert behind is not None and room is not None and room < behind < 0.3
    assert scatter(100, False)["px"] is None
