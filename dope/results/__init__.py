"""From result rows to the paper's tables and curves: found, checked to be of one protocol, laid out, written."""
