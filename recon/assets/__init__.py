"""Assets for the databank: cut out of a scene, or made of a mesh or of splats."""
