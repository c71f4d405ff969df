//! All integration tests in one binary.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod allocations;
mod darkness;
mod exposure;
mod flow;
mod iceoryx2;
mod latest;
mod motion;
mod peers;
mod recording;
mod results;
mod ros2;
mod wire;
mod zenoh;
