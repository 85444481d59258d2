"""Demonstration files: HDF5 in the layout of LIBERO's published demonstrations, read, written and replayed.

A file has a group ``data`` (attributes ``bddl_file_name``, ``problem_info``, ...) with one group a demonstration:
``actions`` [T, 7], ``states`` [T, 1 + nq + nv] (row t is time, qpos, qvel *before* action t), ``rewards`` and ``dones``
[T], and as attributes the state it begins in (``init_state``) and the MJCF it was recorded in (``model_file``), where
fixture poses are. Files of our own evaluations have the same layout; instead of an MJCF they hold the episode and the
arguments of ``vecenv.make``, so that a replay begins bit for bit where the recording did.

``schema`` has the dataclasses, ``read`` and ``write`` the files, ``options`` the arguments of ``vecenv.make`` that a
file holds, ``files`` finds files, ``record`` notes what an evaluation executes, ``replay`` executes it again and
``outcomes`` reports how that went.
"""
