"""A vehicle of two wheel drives on CANopen: CiA 301 for the bus, CiA 402 for the drives (docs/how-to/canopen.md)."""
