"""`dope train`, `dope eval` and `dope figure`: parse, call one function, print. Heavy imports happen inside."""

from dope.commands.evaluate import evaluate
from dope.commands.figure import figure
from dope.commands.train import train

__all__ = ["evaluate", "figure", "train"]
