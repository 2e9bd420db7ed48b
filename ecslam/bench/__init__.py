"""Measurements as commands: the kernels against each other (``kernels``), whole runs and a rival (``speed``), runs
beside the ground truth (``accuracy``), and with many pages open (``viewers``)."""
