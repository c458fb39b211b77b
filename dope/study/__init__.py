"""Studies: many runs that differ in one thing each, trained and evaluated alike, and the table of them."""
