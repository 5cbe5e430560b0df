"""Pictures that tests draw: one ray through a pixel, small ones in reports, charts whose labels may meet; they show the
same in an eighth of the time."""

PLAIN = {
    "lgrasp.dataset.report.write._SIZE": 48,
    "lgrasp.dataset.report.plots._LAYOUT": "none",
    "lgrasp.picture.draw._SAMPLES": 1,
    "lgrasp.picture.draw._RAYS": 1,
}
"""What is set in lgrasp for that."""
