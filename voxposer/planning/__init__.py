"""Value maps, and the paths and pushes planned on them."""
