//! Nightflow turns raw Bayer frames taken in the dark into dense optical flow and velocity.
//!
//! The folders are stages, and their order is the order of the data:
//! [`camera`] → [`exposure`] → [`flow`] → [`motion`] → [`publish`] → [`recording`].
//! [`clock`], [`wire`] and [`handover`] are the ground that every stage stands on; [`config`], [`pipeline`] and [`node`] are
//! the roof. [`darkness`] is the laboratory of the paper that the method comes from ("Optical Flow in the Dark",
//! CVPR 2020). A stage imports the ground and the stages before it, and nothing else.
#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used))]

pub mod camera;
pub mod clock;
pub mod config;
pub mod darkness;
pub mod exposure;
pub mod flow;
pub mod handover;
pub mod motion;
pub mod node;
pub mod pipeline;
pub mod publish;
pub mod recording;
pub mod wire;
