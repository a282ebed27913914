"""The models that are fitted to a detector, one file for each part of a model folder.

`semfov.fit.parts.folder.FolderFit` fits them in order.
"""
