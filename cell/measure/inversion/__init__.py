"""From the cloud to the pose of the nominal surface, with its uncertainty and a verdict."""

from cell.measure.inversion.demands import Demands, fit_figures
from cell.measure.inversion.nominal import NominalSurface
from cell.measure.inversion.observability import PoseVerdict, Tolerance
from cell.measure.inversion.place_pose import PlacePose, invert_pose
from cell.measure.inversion.registration import Prior

__all__ = ["Demands", "NominalSurface", "PlacePose", "PoseVerdict", "Prior", "Tolerance", "fit_figures", "invert_pose"]
