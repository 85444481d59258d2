"""LIBERO: suites, BDDL, scenes, goals and the environment that puts them behind the verbs."""
