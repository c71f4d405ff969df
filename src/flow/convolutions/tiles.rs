//! Products of tiles of bf16: 32 pixels with 32 channels of the output, 32 channels of the input at a time.
//!
//! Intel's AMX does them in its tile registers, AVX-512 with bf16 two products a number at a time; other processors get the
//! same sums from what the compiler makes of arrays, which serves tests and not speed. AMX's instructions are written out, for
//! Rust has no stable functions for them.

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
use super::dots;

/// 32 numbers of 16 bits: a cache line, a row of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C, align(64))]
pub struct Line(pub [u16; LANES]);

impl Line {
    pub const ZERO: Self = Self([0; LANES]);
}

/// Numbers of a line.
pub const LANES: usize = 32;
/// Pixels of a tile, and channels of the output.
pub const SIDE: usize = 16;
/// Lines of the weights for one step: two tiles, for channels 0 to 15 and 16 to 31 of the output.
pub const STEP: usize = 2 * SIDE;

/// Sums of one tile: a row for each pixel, a column for each channel.
pub type Tile = [[f32; SIDE]; SIDE];

/// Sums of 32 pixels: the first 16 with the output's lower and upper channels, then the others.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
pub struct Sums(pub [Tile; 4]);

impl Sums {
    pub const ZERO: Self = Self([[[0.0; SIDE]; SIDE]; 4]);

    /// Of the first or the second 16 pixels, the lower and the upper channels.
    #[inline(always)]
    pub fn half(&self, half: usize) -> [&Tile; 2] {
        [&self.0[2 * half], &self.0[2 * half + 1]]
    }
}

/// What multiplies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Arrays.
    Plain,
    /// Dot products of AVX-512. Only [`Unit::all`] gives it, where there are such.
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    Dots(Vectors),
    /// The tile registers of AMX. Only [`Unit::all`] gives it, where they may be used.
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    Amx(Permitted),
}

/// The proof that the processor has AVX-512 with bf16: AMD's since 2022 (Zen 4), and Intel's that have AMX.
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Vectors(());

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
impl Vectors {
    fn ask() -> Option<Self> {
        let all = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512bf16");
        all.then_some(Self(()))
    }
}

/// The proof that the processor has AMX with bf16 and that the kernel lets this process use it.
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Permitted(());

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
impl Permitted {
    /// Asks the processor, then the kernel, which gives every process that asks the registers' room in its signal frames.
    fn ask() -> Option<Self> {
        use std::arch::x86_64::{__cpuid, __cpuid_count};
        const LEAF: u32 = 7;
        const BF16: u32 = 1 << 22;
        const TILES: u32 = 1 << 24;
        const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
        const XFEATURE_XTILEDATA: libc::c_long = 18;
        if __cpuid(0).eax < LEAF || __cpuid_count(LEAF, 0).edx & (BF16 | TILES) != BF16 | TILES {
            return None;
        }
        // The sums are finished with the vectors of AVX-512; no processor has the one without the other.
        Vectors::ask()?;
        // SAFETY: the call takes two numbers and touches no memory of ours.
        let answer = unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) };
        (answer == 0).then_some(Self(()))
    }
}

impl Unit {
    /// All that this processor has, the fastest last.
    pub fn all() -> Vec<Self> {
        let mut units = vec![Self::Plain];
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        {
            units.extend(Vectors::ask().map(Self::Dots));
            static PERMITTED: std::sync::OnceLock<Option<Permitted>> = std::sync::OnceLock::new();
            units.extend(PERMITTED.get_or_init(Permitted::ask).map(Self::Amx));
        }
        units
    }

    /// The fastest.
    pub fn best() -> Self {
        Self::all().last().copied().unwrap_or(Self::Plain)
    }

    /// Whether it is made for this.
    pub fn is_fast(self) -> bool {
        self != Self::Plain
    }

    /// As people call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "arrays",
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Self::Dots(_) => "AVX-512",
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Self::Amx(_) => "AMX",
        }
    }

    /// Takes the tile registers for this thread until the guard goes.
    pub fn begin(self) -> Begun {
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        if let Self::Amx(_) = self {
            /// Layout of the operand of `ldtilecfg`: palette 1, bytes of a row and rows of each of eight tiles.
            #[repr(C, align(64))]
            struct Shapes {
                palette: u8,
                start_row: u8,
                reserved: [u8; 14],
                row_bytes: [u16; 16],
                rows: [u8; 16],
            }
            let (mut row_bytes, mut rows) = ([0; 16], [0; 16]);
            row_bytes[..8].fill(size_of::<Line>() as u16);
            rows[..8].fill(SIDE as u8);
            let shapes = Shapes { palette: 1, start_row: 0, reserved: [0; 14], row_bytes, rows };
            // SAFETY: the processor has the instruction and the kernel permits it, as `Permitted` proves; the operand is
            // of the layout that it reads.
            unsafe {
                std::arch::asm!("ldtilecfg [{}]", in(reg) &raw const shapes, options(nostack, readonly, preserves_flags));
            }
        }
        Begun(self, std::marker::PhantomData)
    }
}

/// Something to be done with tiles. Implementations must be `#[inline(always)]`, for the processor's features are those of the
/// function that they are inlined into.
pub trait Work {
    /// Does it.
    fn on(self, begun: &Begun);
}

impl Unit {
    /// Does a piece of work that was compiled for this processor.
    pub fn run<W: Work>(self, work: W) {
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq,avx512bf16")]
        fn within<W: Work>(begun: &Begun, work: W) {
            work.on(begun);
        }
        let begun = self.begin();
        match self {
            Self::Plain => work.on(&begun),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            // SAFETY: `Vectors` and `Permitted` prove that the processor has these vectors.
            Self::Dots(_) | Self::Amx(_) => unsafe { within(&begun, work) },
        }
    }
}

/// The tile registers of this thread. They are let go again, for the kernel saves them at every switch while they are held.
pub struct Begun(Unit, std::marker::PhantomData<*const ()>);

impl Drop for Begun {
    fn drop(&mut self) {
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        if let Unit::Amx(_) = self.0 {
            // SAFETY: as in `begin`; the thread's tiles are nobody else's.
            unsafe { std::arch::asm!("tilerelease", options(nostack, nomem, preserves_flags)) };
        }
    }
}

/// Pixels to be multiplied with weights.
#[derive(Debug, Clone, Copy)]
pub struct Block<'a> {
    /// All pixels, as many lines each as their channels take.
    pub pixels: &'a [Line],
    /// The first line of the first pixel of either half.
    pub starts: [usize; 2],
    /// Lines from one of a half's pixels to the next.
    pub stride: usize,
    /// For each step, how many lines further on it reads; ascending.
    pub offsets: &'a [usize],
    /// [`STEP`] lines for each step.
    pub weights: &'a [Line],
}

impl Begun {
    /// The sums over all steps, which with `add` go on from what they are.
    #[inline(always)]
    pub fn multiply(&self, block: &Block<'_>, add: bool, sums: &mut Sums) {
        let Block { pixels, starts, stride, offsets, weights } = *block;
        let furthest = offsets.last().map_or(0, |offset| offset + starts[0].max(starts[1]) + (SIDE - 1) * stride);
        assert!(!offsets.is_empty() && furthest < pixels.len() && weights.len() == offsets.len() * STEP, "{furthest}");
        match self.0 {
            Unit::Plain => plain(block, add, sums),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            // SAFETY: `Vectors` proves that the processor has them.
            Unit::Dots(_) => unsafe { dots::multiply(block, add, sums) },
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            // SAFETY: `begin` has set the tiles' shapes; every line that is read was just seen to be there, since the last
            // offset is the greatest; `Sums` is as large as four tiles.
            Unit::Amx(_) => unsafe {
                let line = size_of::<Line>();
                std::arch::asm!(
                    "tilezero tmm0",
                    "tilezero tmm1",
                    "tilezero tmm2",
                    "tilezero tmm3",
                    "test {add:e}, {add:e}",
                    "jz 2f",
                    "tileloadd tmm0, [{sums} + {line}*1]",
                    "tileloadd tmm1, [{sums} + {line}*1 + 1024]",
                    "tileloadd tmm2, [{sums} + {line}*1 + 2048]",
                    "tileloadd tmm3, [{sums} + {line}*1 + 3072]",
                    "2:",
                    "mov {at}, qword ptr [{offsets}]",
                    "shl {at}, 6",
                    "lea {from}, [{upper} + {at}]",
                    "tileloadd tmm4, [{from} + {stride}*1]",
                    "tileloadd tmm6, [{weights} + {line}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tileloadd tmm7, [{weights} + {line}*1 + 1024]",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "lea {from}, [{lower} + {at}]",
                    "tileloadd tmm5, [{from} + {stride}*1]",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "add {weights}, 2048",
                    "add {offsets}, 8",
                    "dec {count}",
                    "jnz 2b",
                    "tilestored [{sums} + {line}*1], tmm0",
                    "tilestored [{sums} + {line}*1 + 1024], tmm1",
                    "tilestored [{sums} + {line}*1 + 2048], tmm2",
                    "tilestored [{sums} + {line}*1 + 3072], tmm3",
                    add = in(reg) u32::from(add),
                    at = out(reg) _,
                    from = out(reg) _,
                    offsets = inout(reg) offsets.as_ptr() => _,
                    count = inout(reg) offsets.len() => _,
                    upper = in(reg) pixels.as_ptr().add(starts[0]),
                    lower = in(reg) pixels.as_ptr().add(starts[1]),
                    stride = in(reg) stride * line,
                    line = in(reg) line,
                    weights = inout(reg) weights.as_ptr() => _,
                    sums = in(reg) sums.0.as_mut_ptr(),
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    options(nostack),
                );
            },
        }
    }
}

impl Begun {
    /// Whether rows of pixels may be finished with AVX-512.
    pub fn has_vectors(&self) -> bool {
        self.0.is_fast()
    }
}

/// The definition of the product.
#[inline(always)]
fn plain(block: &Block<'_>, add: bool, sums: &mut Sums) {
    if !add {
        *sums = Sums::ZERO;
    }
    for (offset, weights) in block.offsets.iter().zip(block.weights.chunks_exact(STEP)) {
        for (half, start) in block.starts.into_iter().enumerate() {
            for pixel in 0..SIDE {
                let Line(pixels) = &block.pixels[start + offset + pixel * block.stride];
                for (side, weights) in weights.chunks_exact(SIDE).enumerate() {
                    let sums = &mut sums.0[2 * half + side][pixel];
                    for (two, Line(weights)) in pixels.chunks_exact(2).zip(weights) {
                        let (even, odd) = (widened(two[0]), widened(two[1]));
                        for (sum, weights) in sums.iter_mut().zip(weights.chunks_exact(2)) {
                            *sum += even * widened(weights[0]);
                            *sum += odd * widened(weights[1]);
                        }
                    }
                }
            }
        }
    }
}

/// The number that 16 bits of bf16 stand for.
#[inline(always)]
pub fn widened(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}

/// The nearest bf16, of two equally near ones the even one.
#[inline(always)]
pub fn narrowed(value: f32) -> u16 {
    let bits = value.to_bits();
    let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16;
    // What is no number must stay none: rounding could carry it into the sign.
    if value.is_nan() { (bits >> 16) as u16 | 0x40 } else { rounded as u16 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_rounded_to_the_nearest_even() {
        for (value, wanted) in [
            (1.0, 0x3f80),
            (-2.5, 0xc020),
            (1.0 + 1.0 / 256.0, 0x3f80),
            (1.0 + 3.0 / 256.0, 0x3f82),
            (1.0 + 1.01 / 256.0, 0x3f81),
            (0.0, 0),
            (f32::INFINITY, 0x7f80),
            (f32::MAX, 0x7f80),
        ] {
            assert_eq!(narrowed(value), wanted, "{value}");
        }
        assert!(widened(narrowed(f32::NAN)).is_nan() && widened(narrowed(f32::from_bits(0x7f80_0001))).is_nan());
    }

    #[test]
    fn every_unit_gives_the_same_products() {
        let number = |i: usize| narrowed(((i * 7919 % 613) as f32 - 306.0) / 100.0);
        let lines =
            |count, salt| (0..count).map(|i| Line(std::array::from_fn(|j| number(salt + 32 * i + j)))).collect();
        let (pixels, weights): (Vec<Line>, Vec<Line>) = (lines(200, 1), lines(3 * STEP, 5));
        let offsets = [0, 5, 90];
        let block = Block { pixels: &pixels, starts: [0, 40], stride: 3, offsets: &offsets, weights: &weights };
        let mut wanted = Sums::ZERO;
        plain(&block, false, &mut wanted);
        for unit in Unit::all() {
            let (mut found, begun) = (Sums::ZERO, unit.begin());
            for (add, times) in [(false, 1.0), (true, 2.0), (false, 1.0)] {
                begun.multiply(&block, add, &mut found);
                for (a, b) in wanted.0.iter().flatten().flatten().zip(found.0.iter().flatten().flatten()) {
                    assert!((times * a - b).abs() < 2e-3, "{unit:?}: {times} times {a}, {b}");
                }
            }
        }
    }
}
