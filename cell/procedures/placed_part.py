"""Where a placed part was seen, whether it lies in its place, and what most likely happened to one that does not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
import pinocchio as pin

from cell.config.job import FeatureSection, Job, PlaceSection
from cell.measure.geometry.poses import difference, from_parts, perturbed, transform
from cell.measure.inversion.flush import Flush
from cell.measure.inversion.local_deviation import LocalDeviation
from cell.measure.inversion.mating import MatingGap
from cell.measure.inversion.part_pose import SHIFTED, PartPose, of_part
from cell.measure.inversion.whole_face import MOST_UNLIKE, FacePatch
from cell.procedures.part_error import DRAWS, draws_of
from cell.procedures.part_features import NOT_SEEN, FeatureSeen
from drivers.errors import Measured, MisplacedError
from drivers.interfaces import Vector

UNCLEAR = "chance: by no motion is it farther off than was stated before it was put down"
SURE_PERCENT = 99.9
"""Of parts for which the stated bound holds: one that is let go counts as in its place by it."""
CLEARLY = 3.0
"""Standard deviations of the stated place beyond which a part has not come to lie so by chance."""
FLUSH = "flush, beyond its noise"
ROCKED = "the vehicle rocked by {:.2f} mm in the sweep of the part, or its top has such waves: they were taken out"
NO_FLUSH = "how flush its edge is was not seen: no surface shows near it, or a vehicle that rocks moves both by more"
BENT = "the part, or the surface beside it, is bent: look along its edge"
NEXT_STEP = "See to it, take the part away, then run the job with the next part"
OFF_DRAWING = "the part itself is not as drawn there: bent, worn, cut, or another one"
INTERFERENCE_M = 5e-6
"""Interference that form and dirt explain, m, beyond noise and what the pose of the part is off by."""
HANGS_M = 10e-6
"""Clearance that form explains, m: whatever bears a part, some of the squares are closed there."""
OFF_CONTACT = "the part as drawn would {} the surface by {:.2f} mm where it is seen"
ASIDE = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
"""Of a motion, what is along the surface."""
AMISS = "the part is not as drawn: worn below, its underside elsewhere below its upper side, or another one"
ASIDE_UNSEEN = "it lies aside where its faces do not show that, or a piece of it is missing"
COVERED = "something was left on the part: look at its face"
WHOLE = "where the {} {} lies follows from the part as a whole: nobody looked at it by itself"
LIKELY = {
    "raised": "it lies on something, or is another part: look under it",
    "deep": "the part or the surface is worn, or another one",
    "shifted": "it slipped in the claw, or as the claw opened: look at the fingers",
    "tilted": "it stands on something at one edge, or was held tilted: look under it",
}


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """Where the placed part was `seen`, beside where it `belongs` (surface_from_part).

    `points` (45, 3) m, part frame, are those by which a placed part is judged. `covariance` (6, 6) is that of the seen
    pose, surface axes, about the part's origin; `stated` (6, 6) is that of the place before it was put down, which
    stands for the motions that its faces do not show, `unseen`. `gap` is the gap below it, as it lies; None where
    nothing scanned lies below. `flush` is how its edge stands over the surface; None where nothing of that shows beside
    it. `before` is how far off, m, it lay before each correction. `came` is how it came to lie when it was first put
    down, had nothing been allowed for, `slips` how it moved in each correction as the claw opened (`GraspSeries`).
    `named` are the features that the job names, `own` what the points about them say by themselves, by name. `unlike`
    is what of its face is not there, or covered. By its `interference`, m, it seems to go into the surface; below 0 it
    seems to hang above it. `axes` says, for people, whose axes the figures are in.
    """

    seen: PartPose
    belongs: pin.SE3
    points: Vector
    covariance: Vector
    stated: Vector
    unseen: tuple[str, ...] = ()
    gap: MatingGap | None = None
    flush: Flush | None = None
    before: tuple[float, ...] = ()
    came: pin.SE3 | None = None
    slips: tuple[pin.SE3, ...] = ()
    named: tuple[FeatureSection, ...] = ()
    own: Mapping[str, LocalDeviation] = field(default_factory=dict)
    unlike: FacePatch | None = None
    interference: float = 0.0
    axes: str = "the surface's axes"

    @classmethod
    def of(cls, job: Job, seen: PartPose, points: Vector, stated: Vector) -> "PlacedPart":
        """The part as `seen`, with what is not seen of it as it was `stated`, (6, 6), surface axes. Raises
        `MisplacedError` where something is not seen, and the job does not content itself with the rest."""
        unit = np.array([job.place.tolerance] * 3 + [job.place.tolerance_angle] * 3)
        values, ways = np.linalg.eigh(seen.covariance / np.outer(unit, unit))
        weak = ~(3.0 * np.sqrt(np.maximum(values, 0.0)) <= 1.0)
        motions = seen.fit.verdict.weak
        unseen = tuple(of_part(motion.words.partition(" is ")[0]) for motion in motions)
        if unseen and job.place.verify == "all":
            raise MisplacedError(
                f"not all is seen of how the placed part lies: {'; '.join(of_part(m.words) for m in motions)}. Sweep "
                'more of it, or write place.verify = "seen"',
                *(motion.measured() for motion in motions),
            )
        instead = np.einsum("in,ij,jn->n", ways, stated / np.outer(unit, unit), ways)
        kept = (ways * np.where(weak, instead, values)) @ ways.T * np.outer(unit, unit)
        belongs = job.place.surface_from_part.se3()
        # Along what is not seen the part is taken to lie where it belongs: what the fit has there is noise.
        off = ways.T @ (difference(seen.surface_from_part, belongs) / unit)
        there = perturbed(belongs, unit * (ways @ np.where(weak, 0.0, off)))
        return cls(
            replace(seen, surface_from_part=there), belongs, points, covariance=kept, stated=stated, unseen=unseen,
            named=() if job.part is None else job.part.feature,
        )  # fmt: skip

    def over(self, gap: MatingGap | None, before: tuple[float, ...] = ()) -> "PlacedPart":
        """With the `gap` below it, as it was seen, and how far off it lay `before` each correction.

        No part goes into its surface. One that seems to has its underside elsewhere than drawn below its upper side. It
        may lie as far aside as brings it to rest. One that was corrected and then seems to hang was seen wrongly: it
        may lie as far aside as it was moved by that.
        """
        found = replace(self, gap=gap, before=before)
        if gap is None or self.unseen:
            return found
        interference, off, about = 0.0, np.zeros(6), self.seen.surface_from_part.translation
        into = gap.interference - INTERFERENCE_M
        if into > 0.0 and into > gap.by_motions(draws_of(self.covariance)[:DRAWS], about, SURE_PERCENT):
            interference, off = gap.interference, ASIDE * gap.off_contact(about, SHIFTED)
        elif before and gap.clearance > HANGS_M + self.unsure:
            interference, off[:2] = -gap.clearance, before[-1]
        return replace(found, interference=interference, covariance=self.covariance + np.diag(off**2))

    @cached_property
    def offsets(self) -> Vector:
        """How far each point lies from where it belongs, (45, 3) m, surface axes."""
        return transform(self.seen.surface_from_part, self.points) - transform(self.belongs, self.points)

    @property
    def turn(self) -> Vector:
        """By how much the part is turned from where it belongs, (3,) rad, surface axes."""
        return np.asarray(pin.log3(self.seen.surface_from_part.rotation @ self.belongs.rotation.T))

    @cached_property
    def _errors(self) -> Vector:
        """What the points' places may be off by, (2000, 45, 3) m."""
        arms = transform(self.seen.surface_from_part, self.points) - self.seen.surface_from_part.translation
        drawn = draws_of(self.covariance)
        return np.asarray(drawn[:, None, :3] + np.cross(drawn[:, None, 3:], arms))

    @property
    def off(self) -> float:
        """How far its points lie from where they belong, on average, m."""
        return float(np.linalg.norm(self.offsets, axis=1).mean())

    @property
    def aside(self) -> float:
        """The same along the surface alone: how high and how tilted a part lies, what it lies on tells."""
        motion = along_surface(self.belongs.inverse() * self.seen.surface_from_part)
        return float(np.linalg.norm(transform(motion, self.points) - self.points, axis=1).mean())

    @property
    def not_aside(self) -> "PlacedPart":
        """The same part, moved along the surface to where it belongs."""
        motion = self.belongs.inverse() * self.seen.surface_from_part
        there = self.belongs * along_surface(motion).inverse() * motion
        return replace(self, seen=replace(self.seen, surface_from_part=there))

    @cached_property
    def unsure(self) -> float:
        """What 95 % of the points are known to, m."""
        return float(np.percentile(np.linalg.norm(self._errors, axis=-1), 95))

    @cached_property
    def bound(self) -> dict[str, float]:
        """Below what, mm, 95 % of the points lie from where they belong, by axis of the surface's frame and for D.
        Where they were seen counts, and what that may be off by, `SURE_PERCENT`."""
        errors = 1e3 * np.abs(self.offsets + self._errors)
        found = {name: errors[..., k] for k, name in enumerate("xyz")} | {"d": np.linalg.norm(errors, axis=-1)}
        return {
            name: float(np.percentile(np.percentile(each, 95, axis=1), SURE_PERCENT)) for name, each in found.items()
        }

    @cached_property
    def turn_bound(self) -> float:
        """By how much the part is turned at most, rad, `SURE_PERCENT`."""
        turned = self.turn + draws_of(self.covariance)[:, 3:]
        return float(np.percentile(np.linalg.norm(turned, axis=-1), SURE_PERCENT))

    @cached_property
    def features(self) -> tuple[FeatureSeen, ...]:
        """Where the features lie that the job names."""
        motions, lies = draws_of(self.covariance), self.seen.surface_from_part
        where = partial(FeatureSeen.of, seen=lies, belongs=self.belongs, motions=motions, percent=SURE_PERCENT)
        return tuple(where(each, own=self.own.get(each.name, NOT_SEEN)) for each in self.named)

    @property
    def advice(self) -> str:
        """What brings a narrower bound, where the surface was not seen beside the part."""
        return "" if self.seen.beside else ". Leave 10 mm of the surface free beside the part: less is left open then"

    @property
    def words(self) -> str:
        """For people."""
        spans = [f", {name} {found.span}" for name, found in (("gap", self.gap), ("flush", self.flush)) if found]
        where = "" if self.seen.beside else ", against the surface as swept before"
        return f"{1e3 * self.off:.2f} ± {1e3 * self.unsure:.2f} mm off{where}{''.join(spans)}{' mm' if spans else ''}"

    @cached_property
    def _times(self) -> Vector:
        """How far it is off its place, (6,), in standard deviations of the stated place: along x, y, z, and about them,
        about its origin."""
        off = np.concatenate([self.seen.surface_from_part.translation - self.belongs.translation, self.turn])
        return np.asarray(off / np.sqrt(np.diag(self.stated)))

    @property
    def likely(self) -> str:
        """What has most likely happened to a part that does not lie in its place.

        A part that slipped comes to lie on slopes and edges, so it is tilted and raised as well; one that stands on
        something at an edge is raised as well. So the first of them that is clear counts.
        """
        if self.seen.moved is not None:
            return self.pushed[0]
        x, y, z, about_x, about_y, about_z = np.abs(self._times)
        times = {"shifted": max(x, y, about_z), "tilted": max(about_x, about_y)}
        times["raised" if self._times[2] > 0.0 else "deep"] = z
        clear = (name for name, size in times.items() if size > CLEARLY)
        return next((LIKELY[name] for name in clear), UNCLEAR)

    @property
    def off_contact_words(self) -> str:
        """For people, of a part that seems to go into the surface, or to hang."""
        return OFF_CONTACT.format("go into" if self.interference > 0.0 else "hang above", 1e3 * abs(self.interference))

    @property
    def as_it_lies(self) -> str:
        """What has most likely happened to it, by where it was seen and how it would rest there."""
        if not self.interference or self.likely not in (UNCLEAR, LIKELY["shifted"]):
            return self.likely
        return AMISS + f". If it is, {self.likely}" * (self.likely != UNCLEAR)

    @property
    def slipped(self) -> bool:
        """Whether it went to the side farther than chance brings: on a slope that has tilted and raised it as well."""
        return self.likely == LIKELY["shifted"]

    def measured(self, place: PlaceSection) -> tuple[Measured, ...]:
        """What it is judged by, beside its limits: as a whole, along its edge where that shows, and each feature."""
        most = 1e3 * place.tolerance
        flush = () if self.flush is None else (Measured(FLUSH, self.flush.beyond, "mm", most=most),)
        face = () if self.unlike is None else (
            Measured("placed part's face, not there or covered", 1e6 * self.unlike.area, "mm²", most=1e6 * MOST_UNLIKE),
        )  # fmt: skip
        return (
            Measured("placed part off its place, stated bound", self.bound["d"], "mm", most=most),
            Measured(
                "placed part turned, stated bound", 1e3 * self.turn_bound, "mrad", most=1e3 * place.tolerance_angle
            ),
            *flush,
            *face,
            *(feature.measured for feature in self.features),
        )

    def in_tolerance(self, place: PlaceSection) -> bool:
        """Whether it is known to lie within all tolerances, with no piece of its edge clearly out of them."""
        return all(number.kept for number in self.measured(place))

    def misplaced(self, place: PlaceSection, more: str = "") -> MisplacedError:
        """The error of a part that is not known to lie within the place's tolerances."""
        measured = off, turned, *_ = self.measured(place)
        failed = [each for each in self.features if not each.measured.kept]
        out = "".join(f". Out of tolerance: {each.words}" for each in failed)
        out += "" if self.unlike is None else f". {self.unlike.words}"
        out += f". Besides, {self.off_contact_words}" * bool(self.interference)
        likely = self._cause(measured, failed)
        shift = ", ".join(f"{1e3 * v:+.2f}" for v in self.offsets.mean(axis=0))
        turn = ", ".join(f"{1e3 * v:+.1f}" for v in self.turn)
        return MisplacedError(
            f"the placed part lies {self.words}, by ({shift}) mm and ({turn}) mrad in {self.axes}. Allowed are "
            f"{1e3 * place.tolerance:g} mm and {1e3 * place.tolerance_angle:g} mrad; it may be as much as "
            f"{off.value:.2f} mm and {turned.value:.1f} mrad{out}. Most likely {likely}{self.advice}. "
            f"{more}{more and '. '}{NEXT_STEP}",
            *measured,
        ).showing(seen={"placed": self})  # fmt: skip

    def _cause(self, measured: Sequence[Measured], failed: Sequence[FeatureSeen]) -> str:
        """What has most likely happened to a part that was `measured` so, and of which these features failed."""
        off, turned, *_ = measured
        if self.unlike is not None and self.unlike.gone and self.unseen:
            return ASIDE_UNSEEN
        if self.unlike is not None:
            return OFF_DRAWING if self.unlike.gone else COVERED
        if off.kept and turned.kept and any(number.name == FLUSH and not number.kept for number in measured):
            return BENT
        if off.kept and turned.kept and any(each.not_as_drawn for each in failed):
            return OFF_DRAWING
        return self.as_it_lies

    @property
    def notes(self) -> tuple[str, ...]:
        """For people: how it lies, whether that is as usual, and what was not seen."""
        more = f"that is farther off than was stated before it was put down: most likely {self.likely}"
        return (
            f"the placed part lies {self.words}",
            *((ROCKED.format(1e3 * self.seen.rocked),) if self.seen.rocked else ()),
            *(self.flush.notes if self.flush else (NO_FLUSH,) * bool(self.seen.beside)),
            *((more,) if np.abs(self._times).max() > CLEARLY else ()),
            *self.pushed,
            *((self.off_contact_words,) if self.interference else ()),
            *(f"not seen of the placed part: {motion}" for motion in self.unseen),
            *(WHOLE.format(each.section.kind, each.section.name) for each in self.features if not each.asked),
        )

    @property
    def pushed(self) -> tuple[str, ...]:
        """For people: how far surface or vehicle were pushed since the surface was swept; nothing if they were not."""
        if self.seen.moved is None:
            return ()
        shift, turn = (1e3 * float(np.linalg.norm(v)) for v in (self.seen.moved[:3], self.seen.moved[3:]))
        return (f"surface or vehicle was pushed: it stands {shift:.2f} mm and {turn:.1f} mrad from where it was swept",)

    def summary(self) -> dict[str, object]:
        """Figures for journal and report."""
        shift, turn = self.offsets.mean(axis=0), self.turn
        sigma = np.sqrt(np.diag(self.covariance))
        came = {} if self.came is None else {
            "came_mm": [round(1e3 * float(v), 4) for v in self.came.translation[:2]],
            "came_mrad": round(1e3 * float(pin.log3(self.came.rotation)[2]), 4),
        }  # fmt: skip
        return came | {
            "off_mm": round(1e3 * self.off, 4), "unsure_mm": round(1e3 * self.unsure, 4),
            "shift_mm": [round(1e3 * float(v), 4) for v in shift],
            "turn_mrad": [round(1e3 * float(v), 4) for v in turn],
            "sigma_mm": [round(1e3 * float(v), 4) for v in sigma[:3]],
            "sigma_mrad": [round(1e3 * float(v), 4) for v in sigma[3:]],
            "points": self.seen.fit.n_points, "beside": self.seen.beside, "unseen": list(self.unseen),
            "gap": None if self.gap is None else self.gap.as_dict(),
            "flush": None if self.flush is None else self.flush.as_dict(),
            "features": [feature.as_dict() for feature in self.features],
            "unlike": None if self.unlike is None else self.unlike.as_dict(),
            "before_mm": [round(1e3 * off, 4) for off in self.before],
        }  # fmt: skip


def along_surface(motion: pin.SE3) -> pin.SE3:
    """What of a part's motion, its own frame, is along the surface: a part is pressed on, and comes up as it is let go,
    and what it lies on tells how high and how tilted."""
    x, y, _ = motion.translation
    return from_parts((x, y, 0.0), pin.exp3(np.array([0.0, 0.0, pin.log3(motion.rotation)[2]])))
