//! The laboratory of the paper: noise models, synthetic flights and darkness, and evaluation.

pub mod bound;
mod curves;
pub mod datasets;
pub mod enhance;
pub mod fcdn;
pub mod flight;
pub mod flow_files;
pub mod foi;
pub mod gaussians;
pub mod ladder;
pub mod level;
pub mod methods;
pub mod nlm;
pub mod noise;
pub mod pan;
mod path;
pub mod photographs;
pub mod picture;
pub mod plane;
pub mod profiles;
pub mod raws;
pub mod recipes;
pub mod report;
mod scene;
pub mod scenes;
pub mod score;
mod surface;
