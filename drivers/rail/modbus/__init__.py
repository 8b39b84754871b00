"""The rail on a drive that speaks Modbus RTU."""
