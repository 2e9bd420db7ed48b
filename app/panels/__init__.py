"""The panels of the dashboard, one file each; a new file with a class ``Panel`` is found by itself."""
