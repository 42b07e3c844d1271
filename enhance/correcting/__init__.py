"""What is set right without the network: objects' colours and shadows, noise and sharpening, whole frames by photos."""
