"""Others' models that semfov is compared with: bottom-up saliency, and ideal searchers.

Their public names are in `semfov.saliency` and `semfov.acquisition`. An agent looks by none of them.
"""
