"""The engines (``vecenv_eval.engine`` says what one is): ``local``, ``ray`` and ``submitit``."""
