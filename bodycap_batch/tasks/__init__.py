"""The stages as tasks: each task loads its inputs, calls the stage and saves the stage's result.

Each module holds one stage, or a few stages that share code. For each stage, it holds the dataclass that
describes a task, the function that runs the task, and the stage's `Stage` entry. The pipeline creates the
dataclass; the child process reads the dataclass back from JSON.
"""
