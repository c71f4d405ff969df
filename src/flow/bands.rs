//! Rows of planes, cut into bands that different threads may write at the same time.

use std::{
    marker::PhantomData,
    sync::atomic::{AtomicU64, Ordering},
};

/// The most bands that there can be.
pub const MOST: usize = 64;

/// Planes of `height` rows of `width` values, whose rows are handed out in bands, each of them once.
pub struct Bands<'a, T> {
    start: *mut T,
    planes: usize,
    height: usize,
    width: usize,
    /// Rows of a band; the last may have fewer.
    rows: usize,
    taken: AtomicU64,
    memory: PhantomData<&'a mut [T]>,
}

// SAFETY: what a thread gets are bands, each handed out once, and no two bands share a row.
unsafe impl<T: Send> Sync for Bands<'_, T> {}

impl<'a, T> Bands<'a, T> {
    /// Cuts `memory` into bands of so many rows, at most [`MOST`] of them.
    pub fn new(memory: &'a mut [T], [planes, height, width]: [usize; 3], rows: usize) -> Self {
        assert!(
            planes * height * width <= memory.len() && height <= MOST * rows,
            "{planes} × {height} × {width}, {rows}"
        );
        Self { start: memory.as_mut_ptr(), planes, height, width, rows, taken: AtomicU64::new(0), memory: PhantomData }
    }

    /// The band of this number; nothing if there is none or somebody has it already.
    pub fn take(&self, number: usize) -> Option<Band<'_, T>> {
        let first = number.checked_mul(self.rows).filter(|first| *first < self.height)?;
        let bit = 1 << number;
        // Nothing else is told by this bit than whose the band is.
        let taken = self.taken.fetch_or(bit, Ordering::Relaxed) & bit != 0;
        (!taken).then_some(Band { bands: self, first, end: (first + self.rows).min(self.height) })
    }
}

impl<T> Bands<'_, T> {
    /// The first band that nobody has, until who gets it lets go of it. Who is done with one soon finds it free again, with what is
    /// in the caches; [`Bands::take`] must not be used besides.
    pub fn lend(&self) -> Option<Lent<'_, T>> {
        loop {
            // Sees all that whoever let go of the band wrote to it.
            let taken = self.taken.load(Ordering::Acquire);
            let number = taken.trailing_ones();
            let first = (number as usize).checked_mul(self.rows).filter(|first| *first < self.height)?;
            let (bit, order) = (1u64.checked_shl(number)?, Ordering::Acquire);
            if self.taken.compare_exchange_weak(taken, taken | bit, order, Ordering::Relaxed).is_ok() {
                let band = Band { bands: self, first, end: (first + self.rows).min(self.height) };
                return Some(Lent { band, bit });
            }
        }
    }
}

/// A band that is given back when this goes.
pub struct Lent<'a, T> {
    band: Band<'a, T>,
    bit: u64,
}

impl<T> Lent<'_, T> {
    /// The band's first row of the first plane.
    pub fn row(&mut self) -> &mut [T] {
        self.band.row(0, self.band.first)
    }
}

impl<T> Drop for Lent<'_, T> {
    fn drop(&mut self) {
        self.band.bands.taken.fetch_and(!self.bit, Ordering::Release);
    }
}

/// Some rows of every plane.
pub struct Band<'a, T> {
    bands: &'a Bands<'a, T>,
    /// Its first row.
    pub first: usize,
    /// The row after its last.
    pub end: usize,
}

impl<T> Band<'_, T> {
    /// A row of a plane.
    #[inline(always)]
    pub fn row(&mut self, plane: usize, row: usize) -> &mut [T] {
        let Bands { start, planes, height, width, .. } = *self.bands;
        assert!(plane < planes && row >= self.first && row < self.end);
        // SAFETY: the row lies within the memory that `Bands::new` borrowed for good and measured; it belongs to this band
        // alone, which was handed out once and is borrowed here.
        unsafe { std::slice::from_raw_parts_mut(start.add((plane * height + row) * width), width) }
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    #[test]
    fn every_row_is_handed_out_once() {
        let mut memory = vec![0.0; 2 * 5 * 3];
        let bands = Bands::new(&mut memory, [2, 5, 3], 2);
        for number in [2, 0, 1] {
            let mut band = bands.take(number).unwrap();
            assert_eq!((band.first, band.end), (2 * number, (2 * number + 2).min(5)));
            for row in band.first..band.end {
                band.row(1, row).fill(row as f32);
            }
            assert!(bands.take(number).is_none());
        }
        assert!(bands.take(3).is_none() && bands.take(usize::MAX).is_none());
        assert_eq!(memory[..15], [0.0; 15]);
        assert_eq!(memory[15..], [0., 0., 0., 1., 1., 1., 2., 2., 2., 3., 3., 3., 4., 4., 4.]);
    }

    #[test]
    fn what_is_lent_comes_back() {
        let mut memory = vec![0; 3 * 4];
        let bands = Bands::new(&mut memory, [1, 3, 4], 1);
        let (mut one, mut two) = (bands.lend().unwrap(), bands.lend().unwrap());
        one.row().fill(1);
        two.row().fill(2);
        drop(one);
        let (mut again, third) = (bands.lend().unwrap(), bands.lend().unwrap());
        assert_eq!(again.row(), [1; 4]);
        assert!(bands.lend().is_none());
        drop((again, third, two));
        (0..6000).into_par_iter().for_each(|_| {
            let mut band = bands.lend().unwrap();
            let before = band.row()[0];
            band.row().fill(before + 1);
        });
        assert_eq!(memory.chunks(4).map(|row| row[0]).sum::<i32>(), 3 + 6000);
        assert!(memory.chunks(4).all(|row| row == [row[0]; 4]));
    }
}
