"""Made-up places, ray traced from anywhere: pictures, depths and sweeps of a drive, and the truth beside its path."""
