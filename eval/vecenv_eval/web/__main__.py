"""``python -m vecenv_eval.web``: the command ``vecenv serve`` where the console command is not installed."""

import typer

from vecenv_eval.cli.serve import serve_command

if __name__ == "__main__":
    typer.run(serve_command)
