"""A planner that turns language into value maps and waypoints; not built yet, so there is nothing to import here."""
