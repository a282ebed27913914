"""What the parts of a model folder share, and the fit of all of them in order.

A part stands with its fit, such as `semfov.fit.map.MapFit`; that of large pictures is here.
"""
