"""What environments, fits and studies share: settings, workers, progress, stores, and episodes of a protocol."""
