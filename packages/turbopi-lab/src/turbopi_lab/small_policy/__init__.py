"""Makes the small policy that ships with Turbo-Pi: a Pi0.5 of 5.7 M parameters, trained in LIBERO."""
