"""The arm reaches what it should, touches nothing it must not, and moves within its limits.

Arms of every model, as drawn and as calibrated in the factory: against the vendor's description and real tables."""

import struct

import numpy as np
import pinocchio as pin
import pytest

from cell.motion.kinematics import MODELS, ArmKinematics, JointLimits, Unreachable, arm_kinematics, kinematics_name
from drivers.arm.factory import parse_kinematics_info
from drivers.errors import ConfigError
from drivers.interfaces import LinkTable
from sim_backends.models.arm_kinematics import TABLES, Kinematics
from tests.unit.cell.motion.conftest import WORKING, down, independent_fk


def test_every_reachable_pose_is_reached_exactly_and_on_the_branch_asked_for(arm: ArmKinematics):
    rng = np.random.default_rng(2)
    for joints in rng.uniform(-2.9, 2.9, (60, 6)):
        pose = arm.fk(joints)
        near = arm.ik(pose, joints + rng.normal(0, 0.02, 6))
        assert np.allclose(independent_fk(near), pose.homogeneous, atol=1e-9)
        if arm.manipulability(joints) > 0.05:
            assert np.allclose(near, joints, atol=1e-6)


def test_all_eight_branches_over_the_placement_area_are_found(arm: ArmKinematics):
    found = arm.solutions(down(0.75, 0.0, 0.22), WORKING)
    assert len(found) == 8
    far = [float(np.sum((q - WORKING) ** 2)) for q in found]
    assert far == sorted(far)


def test_a_pose_out_of_reach_is_refused_with_the_distance(arm: ArmKinematics):
    with pytest.raises(Unreachable, match=r"out of reach.*stays \d{2,4}\.\d mm"):
        arm.ik(down(1.9, 0.0, 0.3), WORKING)


def test_joint_ranges_are_kept(arm: ArmKinematics):
    tight = ArmKinematics(limits=JointLimits(lower=(-np.pi,) * 6, upper=(np.pi,) * 6))
    for joints in tight.solutions(down(0.75, 0.0, 0.22), np.full(6, 3.1)):
        assert np.all(np.abs(joints) <= np.pi)


@pytest.mark.parametrize("bad", [{"speed": (0.0,) * 6}, {"jerk": (1.0,) * 5}, {"lower": (7.0,) * 6}])
def test_limits_that_make_no_sense_are_refused(bad: dict[str, tuple[float, ...]]):
    with pytest.raises(ValueError, match="joint"):
        JointLimits(**bad)


HALF = np.pi / 2
URDF = {
    "UR3": (0.1519, -0.24365, -0.21325, 0.11235, -0.08535, 0.0819),
    "UR5": (0.089159, -0.425, -0.39225, 0.10915, -0.09465, 0.0823),
    "UR10": (0.1273, -0.612, -0.5723, 0.163941, -0.1157, 0.0922),
    "UR3e": (0.15185, -0.24355, -0.2132, 0.13105, -0.08535, 0.0921),
    "UR5e": (0.1625, -0.425, -0.3922, 0.1333, -0.0997, 0.0996),
    "UR10e": (0.1807, -0.6127, -0.57155, 0.17415, -0.11985, 0.11655),
    "UR16e": (0.1807, -0.4784, -0.36, 0.17415, -0.11985, 0.11655),
    "UR20": (0.2363, -0.862, -0.7287, 0.201, -0.1593, 0.1543),
    "UR30": (0.2363, -0.637, -0.5037, 0.201, -0.1593, 0.1543),
}
"""Of the vendor's `ur_description`, config/*/default_kinematics.yaml: shoulder z, forearm x, wrist 1 x and z, wrist 2
y, wrist 3 y, m. Its joints turn about frames of their own, not those of Denavit and Hartenberg."""

PUBLISHED = {
    "first": (
        "UR10e",
        [-0.000144894975118076141, 303.469135666158195, -309.88394307789747, 6.41459904397394975,
         -4.48232900190081995e-05, -0.00087071402790364627],
        [0.000108651068627930392, 0.240324175250532346, 0.00180628180213493472, 2.63076149165684402e-05,
         3.96638632500012715e-06, 0],
        [1.59613525316931737e-07, -0.917209621528830232, 7.12936131346499469, 0.0710299029424392298,
         -1.64258976526054923e-06, 9.17286101034808787e-08],
        [-0.000444781952841921679, -0.00160215112531214153, 0.00631917793331091861, -0.00165055247340828437,
         0.000763682515545038854, 0],
    ),
    "second": (
        "UR10",
        [0.00065609212979853, 1.4442162376284788, 0.854147723854608, -2.2989425877563705, -1.573498686836816e-05,
         1.9072435590711256e-05],
        [4.6311376834935676e-05, -0.00012568315331862312, 0.00186216581161458, 9.918593870679266e-05,
         4.215462720453189e-06, 0],
        [-7.290070070824746e-05, -0.01713897289704999, -0.03707159413492756, 0.054279462160583214,
         1.488984257025741e-07, 1.551499479707493e-05],
        [0.000211987863869334, -0.0072553625957652995, -0.013483226769541364, 0.0013495820227329425,
         -0.001263136163679901, 0],
    ),
}  # fmt: skip
"""Factory deltas of d, a, theta, alpha of two real arms, published in the tests of the maker's `ur_calibration`."""


def told(name: str) -> LinkTable:
    model, *deltas = PUBLISHED[name]
    drawn = MODELS[model].table
    d, a, theta, alpha = (
        tuple(np.add(base, delta).tolist())
        for base, delta in zip((drawn.d, drawn.a, (0.0,) * 6, drawn.alpha), deltas, strict=True)
    )
    return LinkTable(theta, a, d, alpha)


def of_urdf(name: str, joints: np.ndarray) -> pin.SE3:
    """base_link_inertia to flange (wrist 3) of the vendor's description."""
    z, forearm, x, across, down, out = URDF[name]
    offsets = (
        ((0, 0, z), (0, 0, 0)), ((0, 0, 0), (HALF, 0, 0)), ((forearm, 0, 0), (0, 0, 0)),
        ((x, 0, across), (0, 0, 0)), ((0, down, 0), (HALF, 0, 0)), ((0, out, 0), (HALF, np.pi, np.pi)),
    )  # fmt: skip
    pose = pin.SE3.Identity()
    for (shift, turn), angle in zip(offsets, joints, strict=True):
        pose = pose * pin.SE3(pin.rpy.rpyToMatrix(*turn), np.array(shift, dtype=float))
        pose = pose * pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))
    return pose


@pytest.mark.parametrize("name", list(URDF))
def test_each_model_as_drawn_is_that_of_the_vendors_description(name: str):
    arm, simulated = arm_kinematics(name, None), Kinematics(TABLES[name])
    for joints in np.random.default_rng(3).uniform(-3.0, 3.0, (20, 6)):
        expected = of_urdf(name, joints).homogeneous
        np.testing.assert_allclose(arm.fk(joints).homogeneous, expected, atol=1e-9)
        np.testing.assert_allclose(simulated.forward(joints), expected, atol=1e-9)


def test_the_cell_and_the_world_know_the_same_models():
    assert set(MODELS) == set(TABLES) == set(URDF) | {"UR7e", "UR12e"}


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_a_factory_table_is_kept_exactly_and_its_poses_are_reached(name: str):
    table = told(name)
    arm = arm_kinematics(PUBLISHED[name][0], table)
    rng = np.random.default_rng(5)
    for joints in rng.uniform(-2.5, 2.5, (25, 6)):
        expected = independent_fk(joints + table.theta, table)
        np.testing.assert_allclose(arm.fk(joints).homogeneous, expected, atol=2e-9)
        found = arm.solutions(pin.SE3(expected), joints + rng.uniform(-0.2, 0.2, 6))
        assert any(np.allclose(answer, joints, atol=1e-6) for answer in found)
        for answer in found:
            np.testing.assert_allclose(independent_fk(answer + table.theta, table), expected, atol=1e-6)


@pytest.mark.parametrize("name", ["UR3e", "UR20"])
def test_an_arm_of_another_model_is_named(name: str):
    drawn = MODELS[name].table
    with pytest.raises(ConfigError, match=rf"The nearest model is {name} \(0.0 mm\): correct arm.model"):
        arm_kinematics("UR10e", LinkTable(drawn.theta, drawn.a, drawn.d, drawn.alpha))


def test_a_calibration_is_named_after_the_table_to_the_last_bit():
    table = told("first")
    other = LinkTable(table.theta, table.a, table.d, (*table.alpha[:5], 1e-15))
    names = {kinematics_name("UR10e", t) for t in (None, table, other, told("second"))}
    assert len(names) == 4
    assert kinematics_name("UR10e", told("first")) == kinematics_name("UR10e", table)


def test_kinematics_info_is_read_byte_by_byte():
    numbers = [float(k) / 8 for k in range(24)]
    data = struct.pack(">6I", *range(1, 7)) + struct.pack(">24d", *numbers) + struct.pack(">I", 2)
    assert parse_kinematics_info(data + b"more") == LinkTable(*(tuple(numbers[k : k + 6]) for k in (0, 6, 12, 18)))
