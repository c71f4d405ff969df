//! Convolutions of 3 × 3 in 32 bits by Winograd's minimal filtering, which needs 36 products for 4 × 4 results instead of 144.
//!
//! Lavin and Gray 2016 (*Fast Algorithms for Convolutional Neural Networks*), F(m × m, 3 × 3): with constants Bᵀ, G and Aᵀ, a tile
//! of results is Aᵀ [Σ (G g Gᵀ) ⊙ (Bᵀ d B)] A, the sum being over the input's channels, so that for each of (m + 2)² places the
//! work is a product of matrices. Weights are brought to G g Gᵀ once, in 64 bits. [`forms`] has the constants for m of 2 and 4,
//! [`pixels`] holds maps with their channels side by side, [`layer`] is one convolution, [`product`] multiplies, [`chain`] runs
//! convolutions one after the other from planes to planes, of which in a dense chain each reads all that there is before it. Every
//! result is computed by one thread in a fixed order, so that it does not depend on how many threads there are.

mod chain;
mod forms;
mod layer;
pub(super) mod pixels;
pub(super) mod product;
#[cfg(test)]
mod tests;

pub use chain::Chain;
pub use layer::{Layer, are_equal};

pub use crate::flow::lanes::Unit;
