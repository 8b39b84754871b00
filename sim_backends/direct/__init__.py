"""The world's models behind the devices' interfaces, in this process, on a virtual clock: no wires and no waiting."""
