//! Nightflow: dense optical flow and velocity at night.
