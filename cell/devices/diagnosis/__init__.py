"""How devices are, and which are there: figures with limits, and what is plugged into this computer."""
