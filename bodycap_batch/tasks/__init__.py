"""The stages as tasks: load the inputs, call the stage, save what it returns.

One module holds one stage, or a few that share code: the dataclass that describes its task, the function
that runs it, and its `Stage` entry. The pipeline creates the dataclass; the child process reads it back
from JSON.
"""
