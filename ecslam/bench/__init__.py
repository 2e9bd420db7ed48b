"""Measurements as commands: the kernels against each other (``kernels``), whole runs and a rival (``speed``)."""
