"""Theory of the diffusion Kalman filter: exact errors."""
