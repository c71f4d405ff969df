//! The road in one screen: a frame is developed, paired, and becomes flow and velocity.
