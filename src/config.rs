//! The effective configuration: one section a stage.
