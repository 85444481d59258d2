"""The harness on the command line: ``vecenv eval``, ``vecenv replay`` and ``vecenv bench``, a module each."""
