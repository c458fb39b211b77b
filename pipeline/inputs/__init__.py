"""Stage `frames`: inputs found, frames chosen, judged and written."""
