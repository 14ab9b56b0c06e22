"""The whole denoising loop in one kernel of resident clusters."""
