"""VoxPoser for batches: language becomes programs, programs become value maps, and maps become waypoints.

``voxposer.agent`` runs the method on any environment of ``vecenv.contract``. ``language`` asks a model for programs and
``sandbox`` runs them; ``perception`` gives them objects, ``planning`` turns their maps into plans; ``offline`` is a
rule-based writer of programs that needs no model.
"""
