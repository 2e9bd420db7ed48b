"""The dashboard of ecslam: watch, steer and take away a run in the browser."""
