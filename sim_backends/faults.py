"""The names of all faults that a simulated cell can be made to have; what each does is with its model or peer.

Nothing else is imported here: whoever checks a name need not load the world.
"""

ARM_FAULTS = ("arm.protective_stop", "arm.safeguard_stop", "arm.emergency_stop", "arm.local_control")
CONTROLLER_FAULTS = ("arm.late_states",)
EXCHANGED_SWITCHES, LOST_STEPS = "rail.exchanged_switches", "rail.lost_steps"
RAIL_MODEL_FAULTS = (EXCHANGED_SWITCHES, LOST_STEPS)
RAIL_FAULTS = ("rail.drop_reply", "rail.late_reply", "rail.reset", *RAIL_MODEL_FAULTS)
VEHICLE_MODEL_FAULTS = ("vehicle.emergency_stop", "vehicle.motor_fault")
FOREIGN_COMMANDS, SECOND_VEHICLE = "can.foreign_commands", "can.second_vehicle"
VEHICLE_FAULTS = ("can.bus_off", "can.refused_frames", FOREIGN_COMMANDS, SECOND_VEHICLE, *VEHICLE_MODEL_FAULTS)
CAMERA_FAULTS = ("camera.frame_loss", "camera.silent")
TARGET_CAMERA_FAULTS = tuple(f"target_{name}" for name in CAMERA_FAULTS)
"""Those of the target camera; a name that says only `camera.` is the scan camera's."""

FAULT_NAMES = (*ARM_FAULTS, *CONTROLLER_FAULTS, *RAIL_FAULTS, *VEHICLE_FAULTS, *CAMERA_FAULTS, *TARGET_CAMERA_FAULTS)
