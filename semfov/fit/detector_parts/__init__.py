"""The models that are fitted to a detector, one file for each part of a model folder.

`semfov.fit.detector_parts.workshop.Workshop` fits them in order.
"""
