//! All integration tests in one binary.
#![allow(clippy::unwrap_used, clippy::expect_used)]

<<<<<<< HEAD
mod exposure;
=======
mod flow;
>>>>>>> a14aa14 (feat(flow): dense flow through ONNX Runtime, with confidence and a state)
mod latest;
mod motion;
mod peers;
mod recording;
mod ros2;
mod wire;
