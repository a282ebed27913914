"""Free viewing: how well policies, saliency and centre bias predict where people look next."""
