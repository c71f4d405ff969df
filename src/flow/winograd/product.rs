//! Products of transformed tiles with transformed weights: the one loop that takes nearly all of the time.

use super::pixels::LINE;
use crate::flow::lanes::{Lanes, Work, fetch};

/// Tiles or pixels that are multiplied at once with two vectors of weights: so many sums as fit the registers, of which AVX-512 and NEON
/// have 32 and AVX2 has 16.
pub const MANY: usize = 8;
const FEW: usize = 6;

/// One of the two.
pub fn most<L: Lanes>() -> usize {
    if L::COUNT == 8 { FEW } else { MANY }
}

/// Lines of channels whose products are summed up before they are added to those before: one long sum loses more digits, and
/// tiles of 4 × 4 have none to lose.
const FOLD: usize = 4;

/// What is multiplied, for one of the places of a tile.
#[derive(Clone, Copy)]
pub struct Factors<'a> {
    /// For every [`LINE`] of some channels of the input a line of each tile.
    pub tiles: &'a [[f32; LINE]],
    /// How many tiles there are, a multiple of [`STEP`].
    pub count: usize,
    /// Channels of the input, and which of them these are. Those before them were multiplied already.
    pub inputs: usize,
    pub some: [usize; 2],
    /// For every panel of two vectors of outputs, or the last one of one, those vectors for each input.
    pub weights: &'a [f32],
    /// The same for the next place, which is multiplied then, or nothing.
    pub following: &'a [f32],
}

/// What numbers of tiles are multiples of.
pub const STEP: usize = 2;

/// Vectors of a panel that begins with this output.
pub fn panel<L: Lanes>(outputs: usize, first: usize) -> usize {
    if outputs - first >= 2 * L::COUNT { 2 } else { 1 }
}

/// Adds the sums over those inputs to those over the ones before, `to` having a row of `outputs` values (a multiple of [`LINE`]) for each tile.
#[inline(always)]
pub fn multiply<L: Lanes>(lanes: L, factors: Factors<'_>, to: &mut [f32], outputs: usize) {
    let (most, [begin, end]) = (most::<L>(), factors.some);
    let (mut first, mut weights) = (0, factors.weights);
    let blocks = factors.count.div_ceil(most);
    while first < outputs {
        let vectors = panel::<L>(outputs, first);
        let wide = vectors * L::COUNT;
        let (those, others) = weights.split_at(factors.inputs * wide);
        // What comes next is fetched meanwhile, a part of it with every block of tiles.
        let next = if others.is_empty() { factors.following } else { others };
        let width =
            if others.is_empty() { panel::<L>(outputs, 0) } else { panel::<L>(outputs, first + wide) } * L::COUNT;
        let next = next.get(begin * width..end * width).unwrap_or(&[]);
        let mut ahead = next.chunks(next.len().div_ceil(blocks).next_multiple_of(LINE).max(1));
        let those = &those[begin * wide..end * wide];
        let mut tile = 0;
        while tile < factors.count {
            let left = factors.count - tile;
            // Blocks that are as good as equal: sums of a small one wait for each other.
            let left = left.div_ceil(left.div_ceil(most)).next_multiple_of(STEP);
            let to = &mut to[tile * outputs + first..];
            let factors = Factors { weights: those, following: ahead.next().unwrap_or(&[]), ..factors };
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
        (weights, first) = (others, first + wide);
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
        let Self { factors: Factors { tiles, count, some: [first, end], weights, following, .. }, tile, to, outputs } =
            self;
        let lines = (end - first).div_ceil(LINE);
        let mut ahead = following.chunks(following.len().div_ceil(lines).next_multiple_of(LINE).max(1));
        for (group, weights) in weights.chunks(FOLD * LINE * N * L::COUNT).enumerate() {
            let mut sums = [[lanes.splat(0.0); N]; R];
            for (line, weights) in weights.chunks(LINE * N * L::COUNT).enumerate() {
                fetch(ahead.next().unwrap_or(&[]));
                let line = group * FOLD + line;
                let Some((tiles, _)) = tiles[line * count + tile..].split_first_chunk::<R>() else { return };
                let channels = LINE.min(end - first - line * LINE);
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
            let (mut rows, begun) = (to.chunks_mut(outputs), first + group > 0);
            let give = |sum: L::V, to: &mut [f32]| {
                let sum = if begun { lanes.add(lanes.load(to), sum) } else { sum };
                lanes.store(sum, to);
            };
            macro_rules! each {
                ($($r:literal)*) => { $(if let (true, Some(to)) = ($r < R, rows.next()) {
                    give(sums[$r % R][0], to);
                    if N > 1 {
                        give(sums[$r % R][N - 1], &mut to[L::COUNT..]);
                    }
                })* };
            }
            each!(0 1 2 3 4 5 6 7);
        }
    }
}
