"""Every table, figure and equation of the thesis beside ours: what it states, what we find, and a verdict by a rule."""

__version__ = "0.3.0.dev0"
