//! The laboratory of the paper: noise models, synthetic flights and darkness, and evaluation.

pub mod flight;
pub mod flow_files;
pub mod level;
pub mod noise;
pub mod pan;
mod path;
pub mod profiles;
mod scene;
mod surface;
