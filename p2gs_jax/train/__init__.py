"""The optimisation: one jitted step, its schedule, and the host loop around it."""
