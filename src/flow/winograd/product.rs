//! Products of transformed tiles with transformed weights: the one loop that takes nearly all of the time.

use super::pixels::LINE;
use crate::flow::lanes::{Lanes, Work};

/// Tiles that are multiplied at once with two vectors of weights: so many sums as fit the registers, of which AVX-512 and NEON
/// have 32 and AVX2 has 16.
const MANY: usize = 8;
const FEW: usize = 6;

/// What is multiplied, for one of the 16 places of a tile.
#[derive(Clone, Copy)]
pub struct Factors<'a> {
    /// For every [`LINE`] channels of the input a line of each tile.
    pub tiles: &'a [[f32; LINE]],
    /// How many tiles there are, a multiple of [`STEP`].
    pub count: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// For every panel of two vectors of outputs, or the last one of one, those vectors for each input.
    pub weights: &'a [f32],
}

/// What numbers of tiles are multiples of.
pub const STEP: usize = 2;

/// Vectors of a panel that begins with this output.
pub fn panel<L: Lanes>(outputs: usize, first: usize) -> usize {
    if outputs - first >= 2 * L::COUNT { 2 } else { 1 }
}

/// Sums over the inputs, `to` having a row of `outputs` values (a multiple of [`LINE`]) for each tile.
#[inline(always)]
pub fn multiply<L: Lanes>(lanes: L, factors: Factors<'_>, to: &mut [f32], outputs: usize) {
    let (most, mut first, mut weights) = (if L::COUNT == 8 { FEW } else { MANY }, 0, factors.weights);
    while first < outputs {
        let vectors = panel::<L>(outputs, first);
        let (those, others) = weights.split_at(factors.inputs * vectors * L::COUNT);
        let mut tile = 0;
        while tile < factors.count {
            let left = (factors.count - tile).min(most);
            let to = &mut to[tile * outputs + first..];
            let factors = Factors { weights: those, ..factors };
            match (vectors, left) {
                (2, 8) => lanes.enter(Block::<8, 2> { factors, tile, to, outputs }),
                (2, 6) => lanes.enter(Block::<6, 2> { factors, tile, to, outputs }),
                (2, 4) => lanes.enter(Block::<4, 2> { factors, tile, to, outputs }),
                (2, _) => lanes.enter(Block::<2, 2> { factors, tile, to, outputs }),
                (_, 8) => lanes.enter(Block::<8, 1> { factors, tile, to, outputs }),
                (_, 6) => lanes.enter(Block::<6, 1> { factors, tile, to, outputs }),
                (_, 4) => lanes.enter(Block::<4, 1> { factors, tile, to, outputs }),
                (_, _) => lanes.enter(Block::<2, 1> { factors, tile, to, outputs }),
            }
            tile += left;
        }
        (weights, first) = (others, first + vectors * L::COUNT);
    }
}

/// `R` tiles with a panel of `N` vectors.
struct Block<'a, const R: usize, const N: usize> {
    factors: Factors<'a>,
    tile: usize,
    to: &'a mut [f32],
    outputs: usize,
}

impl<const R: usize, const N: usize> Work for Block<'_, R, N> {
    #[inline(always)]
    fn on<L: Lanes>(self, lanes: L) {
        let Self { factors: Factors { tiles, count, inputs, weights }, tile, to, outputs } = self;
        let mut sums = [[lanes.splat(0.0); N]; R];
        for (line, weights) in weights.chunks(LINE * N * L::COUNT).enumerate() {
            let Some((tiles, _)) = tiles[line * count + tile..].split_first_chunk::<R>() else { return };
            let channels = LINE.min(inputs - line * LINE);
            for (k, weights) in weights.chunks_exact(N * L::COUNT).enumerate().take(channels) {
                let near = lanes.load(weights);
                let far = if N > 1 { lanes.load(&weights[L::COUNT..]) } else { near };
                // Written out, for a loop may leave the sums in memory.
                macro_rules! each {
                    ($($r:literal)*) => { $(if $r < R {
                        let value = lanes.splat(tiles[$r % R][k]);
                        sums[$r % R][0] = lanes.fused(value, near, sums[$r % R][0]);
                        if N > 1 {
                            sums[$r % R][N - 1] = lanes.fused(value, far, sums[$r % R][N - 1]);
                        }
                    })* };
                }
                each!(0 1 2 3 4 5 6 7);
            }
        }
        let mut rows = to.chunks_mut(outputs);
        macro_rules! each {
            ($($r:literal)*) => { $(if let (true, Some(to)) = ($r < R, rows.next()) {
                lanes.store(sums[$r % R][0], to);
                if N > 1 {
                    lanes.store(sums[$r % R][N - 1], &mut to[L::COUNT..]);
                }
            })* };
        }
        each!(0 1 2 3 4 5 6 7);
    }
}
