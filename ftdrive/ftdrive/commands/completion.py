"""`ftdrive completion`: completion of commands, options and files for a shell."""

import click
from click.shell_completion import get_completion_class

from ftdrive.terminal.text import echo

_INSTALLED_BY = {
    "bash": """echo 'eval "$(ftdrive completion bash)"' >> ~/.bashrc""",
    "zsh": """echo 'eval "$(ftdrive completion zsh)"' >> ~/.zshrc""",
    "fish": "ftdrive completion fish > ~/.config/fish/completions/ftdrive.fish",
}


@click.command()
@click.argument("shell", type=click.Choice(list(_INSTALLED_BY)))
def completion(shell: str) -> None:
    """Print the completion script for SHELL, and the line that installs it for each new terminal."""
    made = get_completion_class(shell)
    root = click.get_current_context().find_root()
    if made is None:
        raise click.UsageError(f"this version of click has no completion for {shell}", root)
    echo(f"# Install it once, then open a new terminal: {_INSTALLED_BY[shell]}", fold=False)
    echo(made(root.command, {}, "ftdrive", "_FTDRIVE_COMPLETE").source(), fold=False)
