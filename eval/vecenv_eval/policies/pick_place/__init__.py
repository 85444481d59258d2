"""``pick_place``: the scripted policy for LIBERO; ``policy`` has the class, the other modules its parts."""
