"""A LIBERO scene: BDDL and assets in, one compiled MuJoCo model out, with its goals, parts and surfaces."""
