"""A batch of environments that is driven live: played, paused, stepped, and watched.

:class:`~vecenv_eval.panel.session.Session` is the one object that a server or a notebook needs; ``state`` has what it
publishes. Nothing here knows HTTP.
"""
