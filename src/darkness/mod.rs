//! The laboratory of the paper: noise models, synthetic flights and darkness, and evaluation.

mod curves;
pub mod fcdn;
pub mod flight;
pub mod flow_files;
pub mod gaussians;
pub mod level;
pub mod noise;
pub mod pan;
mod path;
pub mod profiles;
pub mod recipes;
mod scene;
mod surface;
