//! The laboratory of the paper: noise models, synthetic flights and darkness, and evaluation.

pub mod noise;
