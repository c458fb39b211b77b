"""What became of every sequence: `dope prep status` (a table) and `dope prep report` (a page to look at)."""
