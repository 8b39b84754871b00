"""The map of a run's picture: its scale, its words, and what is shown where no surface was found."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cell.measure.inversion.flush import Flush
from cell.run.report.pictures import SurfacePanel, draw_surface


def surface_axes(panel: SurfacePanel, seams: list[dict[str, Any]]) -> tuple[Any, Any]:
    figure = Figure()
    axes = figure.subplots()
    draw_surface(figure, axes, panel, 0.2, seams)
    return axes, figure.axes[1]


def test_the_map_of_deviations_has_a_fixed_scale_in_mm():
    points = np.column_stack([*np.random.default_rng(1).uniform(-0.02, 0.02, (2, 4000)), np.zeros(4000)])
    for size in (1e-6, 1e-3):
        axes, colours = surface_axes(SurfacePanel(points, np.full(4000, size), believed=True), [])
        assert colours.get_ylim() == (-0.2, 0.2)
        assert colours.get_ylabel() == "deviation from the drawn surface in mm"
        assert f"{1e3 * size:.3f} mm RMS" in axes.get_title()
        assert axes.get_xlabel().endswith("in mm")


def test_a_surface_that_was_not_found_is_shown_by_its_height():
    points = np.array([[0.0, 0.0, 0.001], [0.01, 0.0, 0.002]])
    axes, colours = surface_axes(SurfacePanel(points, None, believed=False), [])
    assert colours.get_ylabel() == "height in mm"
    assert "not found" in axes.get_title()
    surface_axes(SurfacePanel(points[:0], points[:0, 0], believed=True), [])


def test_the_flush_of_a_placed_part_has_the_colours_of_the_map():
    points = np.column_stack([*np.random.default_rng(1).uniform(-0.02, 0.02, (2, 400)), np.zeros(400)])
    flush = Flush(points[:3], np.array([-0.1e-3, 0.0, 0.3e-3]), np.full(3, 0.05e-3))
    axes, _ = surface_axes(SurfacePanel(points, np.zeros(400), believed=True, flush=flush), [])
    pieces = axes.collections[-1]
    assert pieces.get_clim() == (-0.2, 0.2) and np.allclose(pieces.get_array(), [-0.1, 0.0, 0.3])
    assert np.allclose(pieces.get_offsets(), 1e3 * points[:3, :2])
    assert "framed: flush" in axes.get_title()
