"""Where people are told things: stderr, for stdout is for data."""

import sys

from rich.console import Console

talk = Console(stderr=True, highlight=False, soft_wrap=not sys.stderr.isatty())
"""A terminal gets whole words, a file whole lines."""
