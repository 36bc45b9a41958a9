"""What is simulated: TOML to checked dataclasses and back."""
