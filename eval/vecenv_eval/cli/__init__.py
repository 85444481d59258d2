"""The harness on the command line, a module for each command; ``options`` makes options of the fields of a config."""
