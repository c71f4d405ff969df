//! Convolutions of 3 × 3 in 32 bits by Winograd's minimal filtering, which needs 16 products for 2 × 2 results instead of 36.
//!
//! Lavin and Gray 2016 (*Fast Algorithms for Convolutional Neural Networks*), F(2 × 2, 3 × 3): with the constants Bᵀ, G and Aᵀ
//! there, a tile of results is Aᵀ [Σ (G g Gᵀ) ⊙ (Bᵀ d B)] A, the sum being over the input's channels, so that for each of 16
//! places the work is a product of matrices. Weights are brought to G g Gᵀ once, in 64 bits. [`pixels`] holds maps with their
//! channels side by side, [`layer`] is one convolution, [`product`] multiplies, [`chain`] runs convolutions one after the
//! other from planes to planes. Every result is computed by one thread in a fixed order, so that it does not depend on how many
//! threads there are.

mod chain;
mod forms;
mod layer;
mod pixels;
mod product;
#[cfg(test)]
mod tests;

pub use chain::Chain;
pub use layer::{Layer, are_equal};

pub use crate::flow::lanes::Unit;
