//! One level of the db3 wavelet: what of a picture is coarse, and what is its finest diagonal detail.

/// Daubechies' scaling filter with three vanishing moments (db3), of norm 1 and sum √2.
const SCALING: [f32; 6] = [0.332_670_55, 0.806_891_5, 0.459_877_5, -0.135_011_02, -0.085_441_27, 0.035_226_293];

/// Half the pixels each way, without the border where the filter has no room.
#[derive(Debug, Clone)]
pub(super) struct Wavelet {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Local means: white noise of deviation σ has σ/2 in here.
    pub approximation: Vec<f32>,
    /// Diagonal detail: of a smooth picture nearly nothing, of white noise the same σ, and independent of the means.
    pub detail: Vec<f32>,
}

/// The coefficients that a side of so many pixels has.
pub(super) const fn coefficients(side: usize) -> usize {
    if side < SCALING.len() { 0 } else { (side - SCALING.len()) / 2 + 1 }
}

/// Takes the picture (`height` × `width`) apart.
pub(super) fn split(plane: &[f32], width: usize, height: usize) -> Wavelet {
    let (columns, rows) = (coefficients(width), coefficients(height));
    let mut low = vec![0.0; columns * height];
    let mut high = vec![0.0; columns * height];
    for (y, row) in plane.chunks_exact(width).enumerate() {
        for x in 0..columns {
            let (mut sum, mut difference) = (0.0, 0.0);
            for (k, value) in row[2 * x..2 * x + SCALING.len()].iter().enumerate() {
                sum += SCALING[k] * value;
                difference += mirror(k) * value;
            }
            low[y * columns + x] = sum * std::f32::consts::FRAC_1_SQRT_2;
            high[y * columns + x] = difference;
        }
    }
    let mut approximation = vec![0.0; columns * rows];
    let mut detail = vec![0.0; columns * rows];
    for y in 0..rows {
        for (k, scaling) in SCALING.iter().enumerate() {
            let from = (2 * y + k) * columns;
            let here = y * columns;
            for x in 0..columns {
                approximation[here + x] += scaling * std::f32::consts::FRAC_1_SQRT_2 * low[from + x];
                detail[here + x] += mirror(k) * high[from + x];
            }
        }
    }
    Wavelet { width: columns, height: rows, approximation, detail }
}

/// The wavelet filter: the scaling filter backwards, every second sign turned.
const fn mirror(k: usize) -> f32 {
    let value = SCALING[SCALING.len() - 1 - k];
    if k.is_multiple_of(2) { value } else { -value }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_filters_are_those_of_an_orthonormal_wavelet() {
        let dot = |a: &dyn Fn(usize) -> f32, b: &dyn Fn(usize) -> f32, shift: usize| -> f32 {
            (0..6 - shift).map(|k| a(k + shift) * b(k)).sum()
        };
        let (scaling, wavelet) = (|k: usize| SCALING[k], mirror);
        for shift in [0, 2, 4] {
            let expected = if shift == 0 { 1.0 } else { 0.0 };
            assert!((dot(&scaling, &scaling, shift) - expected).abs() < 1e-6);
            assert!((dot(&wavelet, &wavelet, shift) - expected).abs() < 1e-6);
            assert!(dot(&scaling, &wavelet, shift).abs() < 1e-6 && dot(&wavelet, &scaling, shift).abs() < 1e-6);
        }
        for power in 0..3 {
            let moment: f32 = (0..6).map(|k| mirror(k) * (k as f32).powi(power)).sum();
            assert!(moment.abs() < 1e-5, "moment {power} is {moment}");
        }
    }

    #[test]
    fn a_parabola_has_no_detail_and_keeps_its_mean() {
        let plane: Vec<f32> =
            (0..20 * 16).map(|i| 0.3 + 0.01 * (i % 20) as f32 + 2e-3 * ((i / 20) as f32).powi(2)).collect();
        let Wavelet { width, height, approximation, detail } = split(&plane, 20, 16);
        assert_eq!((width, height), (8, 6));
        assert!(detail.iter().all(|value| value.abs() < 1e-5));
        // The scaling filter's centre lies 0.82 pixels after its first.
        assert!((approximation[0] - (0.3 + 0.0082 + 2e-3 * 0.67)).abs() < 2e-3, "{}", approximation[0]);
    }
}
