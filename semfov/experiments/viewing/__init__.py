"""Free viewing: how well policies, saliency and centre bias foretell where people look next."""
