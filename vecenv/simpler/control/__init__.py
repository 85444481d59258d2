"""SIMPLER's robots: kinematics, controllers, servoing."""
