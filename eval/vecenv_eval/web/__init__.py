"""``vecenv serve``: a live session over HTTP and WebSockets (docs/serve.md).

``app.create_app`` makes the application, ``server.running`` runs it; nothing here is imported by the rest of the
harness.
"""
