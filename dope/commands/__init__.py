"""`dope train`, `eval`, `results`, `study` and `figure`: parse, call one function, print. Heavy imports happen inside."""

from dope.commands.evaluate import evaluate
from dope.commands.figure import figure
from dope.commands.results import results
from dope.commands.study import study
from dope.commands.train import train

__all__ = ["evaluate", "figure", "results", "study", "train"]
