"""A Python policy as a server: ``vecenv serve-policy module:Policy --as openpi|vla-eval|gr00t``.

``policy`` says what a policy has to offer; ``openpi``, ``vla_eval`` and ``gr00t`` speak one protocol each.
"""
