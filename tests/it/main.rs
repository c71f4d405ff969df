//! All integration tests in one binary.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod allocations;
mod bags;
mod darkness;
mod exposure;
mod fcdn;
mod flow;
mod flow_files;
mod iceoryx2;
mod latest;
mod live;
mod motion;
mod noise;
mod peers;
mod recording;
mod recordings;
mod results;
mod road;
mod ros2;
mod show;
mod soak;
mod tidy;
mod torn;
mod wire;
mod zenoh;
