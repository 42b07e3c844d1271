"""Registration: path, mounts and clocks corrected before the fit, by where sweeps meet, and pictures on surfaces and on the road."""
