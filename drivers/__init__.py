"""One device each: its protocol, its limits, its faults. Knows neither the cell nor the simulator."""
