"""How good a reconstruction is: held-out pictures, while a fit runs and at its end, and held-out lidar and photos beside the path."""
