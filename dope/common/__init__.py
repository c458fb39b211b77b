"""What both rooms, `pipeline` and `dope`, stand on: errors, settings, seeds and safe files. No heavy imports."""
