"""From the cloud to the pose of the nominal surface, with its uncertainty and a verdict."""

from cell.inversion.demands import Demands, fit_figures
from cell.inversion.nominal import NominalSurface
from cell.inversion.observability import Tolerance, Verdict
from cell.inversion.place_pose import PlacePose, invert_pose
from cell.inversion.registration import Prior

__all__ = ["Demands", "NominalSurface", "PlacePose", "Prior", "Tolerance", "Verdict", "fit_figures", "invert_pose"]
