"""The make `ur` of arms, and `arm_output` of lasers and claws that hang on an arm's connectors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from drivers.common.addresses import Host
from drivers.make import (
    MOST_PAYLOAD,
    AnyMake,
    ArmConfig,
    ClawConfig,
    Connector,
    LaserConfig,
    Make,
    OnArm,
    Surroundings,
    with_endpoint,
)
from drivers.packages import lacking

if TYPE_CHECKING:
    from drivers.arm.ur import UrArm
    from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser


class UrArmConfig(ArmConfig):
    """An arm of Universal Robots' e-series."""

    driver: Literal["ur"] = "ur"
    address: Annotated[str, Host]


class ArmOutputLaserConfig(LaserConfig, OnArm):
    """A laser that an output of the arm switches."""

    driver: Literal["arm_output"] = "arm_output"


class ArmOutputClawConfig(ClawConfig, OnArm):
    """A claw that an output of the arm closes; an input of the arm shows a held part."""

    driver: Literal["arm_output"] = "arm_output"
    feedback: Connector


def _connect(name: str, config: UrArmConfig, around: Surroundings) -> UrArm:
    from drivers.arm.limits import ArmLimits
    from drivers.arm.ur import UrArm

    return UrArm(
        name,
        config.address,
        clock=around.clock,
        limits=ArmLimits(
            joint_speeds=(config.max_joint_speed,) * 6,
            joint_acceleration=config.max_joint_acceleration,
            linear_speed=config.max_tool_speed,
            reach=around.require_reach(),
            payload=MOST_PAYLOAD[config.model],
        ),
        payload=(config.payload, config.payload_centre),
        safe_off_outputs=around.safe_off_outputs,
        forward_of=around.forward_of,
        control=not around.look,
        model=config.model,
    )


def _laser(name: str, config: ArmOutputLaserConfig, around: Surroundings) -> ArmSwitchedLaser:
    from drivers.switches import ArmSwitchedLaser

    return ArmSwitchedLaser(name, around.require_arm(), config.output)


def _claw(name: str, config: ArmOutputClawConfig, around: Surroundings) -> ArmSwitchedClaw:
    from drivers.switches import ArmSwitchedClaw

    return ArmSwitchedClaw(name, around.require_arm(), config.output, config.feedback, clock=around.clock)


UR: AnyMake = Make(
    "arm", "ur", UrArmConfig, _connect, frozenset(("model",)), simulated=with_endpoint("address"),
    missing=lambda: lacking("rtde_control", "ur-rtde"),
)  # fmt: skip
ON_OUTPUTS: tuple[AnyMake, ...] = (
    Make(
        "laser", "arm_output", ArmOutputLaserConfig, _laser, frozenset(("baseline", "tan_theta")),
        simulated=with_endpoint(), on_arm=True,
    ),
    Make("claw", "arm_output", ArmOutputClawConfig, _claw, simulated=with_endpoint(), on_arm=True),
)  # fmt: skip
