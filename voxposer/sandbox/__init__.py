"""Running programs that nobody has vetted, within limits of time, memory and reach."""
