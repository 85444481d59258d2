"""Recording episodes as LIBERO's HDF5 demonstrations, and replaying them."""
