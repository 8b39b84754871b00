"""URScript on the simulated controller: translated into Python's generators, one step of them a control cycle."""
