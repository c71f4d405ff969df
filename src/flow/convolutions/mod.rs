//! The operators `nightflow::Convolutions` and `nightflow::Encoder`: convolutions in bf16 by the processor's matrix tiles or dot
//! products, and in 32 bits: chains by [`super::winograd`], the encoder's as they are defined.
//!
//! Pixels lie with their channels side by side ([`map`]), so that a tile of 16 pixels is read as it is, for every weight from
//! another place ([`layer`]): no copy of the picture is made for the multiplication's sake. Products of bf16 have sums of 32
//! bits. [`chain`] runs convolutions one after the other, [`encoder`] the network's feature encoder with its norms; what goes
//! in and comes out are planes of f32, as ONNX has them. Every result is computed by one thread in a fixed order, so that it
//! does not depend on how many threads there are.

pub(super) mod chain;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod dots;
mod encoder;
mod layer;
mod map;
mod operator;
mod rows;
#[cfg(test)]
pub(super) mod tests;
mod tiles;

pub use chain::{Chain, Unfit};
pub use encoder::{CONVOLUTIONS, Encoder, Narrow, View, Weights, Wide};
pub use layer::{Layer, Step};
pub use operator::{Convolutions, Encode};
pub use tiles::Unit;

/// Calls its second argument with every number below its first, on whatever threads, and comes back when that is done; its
/// error ends the work.
pub trait Spread<E>: Fn(usize, &(dyn Fn(usize) + Sync)) -> Result<(), E> {}

impl<E, F: Fn(usize, &(dyn Fn(usize) + Sync)) -> Result<(), E>> Spread<E> for F {}
