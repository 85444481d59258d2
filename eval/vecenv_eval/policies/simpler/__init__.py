"""``simpler_scripted``: the scripted policy for SIMPLER; ``policy`` has the class, the other modules its parts."""
