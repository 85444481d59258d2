"""Controllers as pure JAX functions of batched state: operational-space arm control, gripper, waypoint servo."""
