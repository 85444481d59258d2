"""Policies that run as servers: clients for the protocols of openpi, vla-evaluation-harness, GR00T and StarVLA.

``vecenv eval --policy openpi --policy-arg host=... --policy-arg port=...`` evaluates such a server. A client observes
the slots whose queue of actions is empty, sends what the protocol says, and hands the environment one action a slot and
tick. ``base`` has what the clients share, ``codecs`` the messages, ``websocket`` and ``zmq`` the connections.
"""
