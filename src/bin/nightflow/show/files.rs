//! Flow files and folders of pairs: frames, flow, what stays in sight, and the error against a truth.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use image::RgbImage;
use indicatif::ProgressBar;
use nightflow::darkness::flow_files::{self, Field};

use super::{Args, Row, Story, error_fact, plates::Plate, summed};

/// Reads every flow that was named, or that stands in the folders that were named.
pub fn look(args: &Args) -> Result<Story> {
    let mut flows = Vec::new();
    for path in &args.paths {
        if path.is_dir() { flows.extend(pairs(path)?) } else { flows.push(path.clone()) }
    }
    if flows.len() > 1 && (args.image1.is_some() || args.image2.is_some() || args.truth.is_some()) {
        bail!("--image1, --image2 and --truth belong to one flow file, {} were named", flows.len());
    }
    let first = &args.paths[0];
    let name = if flows.len() == 1 { &flows[0] } else { first };
    let mut story = Story { title: format!("{}", name.display()), ..Story::default() };
    let step = flows.len().div_ceil(args.most.max(1)).max(1);
    let bar = ProgressBar::new(flows.len() as u64);
    let (mut pixels, mut known, mut lengths) = (0, 0, 0.0);
    for (index, path) in flows.iter().enumerate() {
        let field = flow_files::read(path)?;
        let (row, plate) = pair(args, path, &field)?;
        pixels += field.vectors.len();
        for vector in (0..field.vectors.len()).filter(|i| field.known(*i)).map(|i| field.vectors[i]) {
            known += 1;
            lengths += f64::from(vector[0].hypot(vector[1]));
        }
        story.rows.push(row);
        if index % step == 0 {
            story.plates.push(plate);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let part = 100.0 * known as f64 / pixels.max(1) as f64;
    story.facts.push(("flow".into(), format!("{} pairs, known in {part:.1} % of the pixels", flows.len())));
    story.facts.push(("displacement".into(), format!("{:.2} px in the mean", lengths / f64::from(known.max(1)))));
    story.facts.extend(error_fact(&story.rows, "pairs"));
    Ok(story)
}

/// The flow files of a folder in FlyingChairs' layout, or all flow files that it has, by name.
fn pairs(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let mut flows: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    flows.retain(|path| path.extension().is_some_and(|ending| ending == "flo"));
    flows.sort();
    if flows.is_empty() {
        bail!(
            "{}: expected pairs as NAME_flow.flo, NAME_img1.ppm, NAME_img2.ppm, found no .flo file",
            folder.display()
        );
    }
    Ok(flows)
}

fn pair(args: &Args, path: &Path, field: &Field) -> Result<(Row, Plate)> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let name = stem.strip_suffix("_flow").unwrap_or(&stem).to_owned();
    let beside = |given: &Option<PathBuf>, which: &str| -> Result<Option<RgbImage>> {
        let found = given.clone().or_else(|| {
            let endings = ["ppm", "png", "jpg"].iter();
            endings.map(|ending| path.with_file_name(format!("{name}_{which}.{ending}"))).find(|path| path.is_file())
        });
        let Some(found) = found else { return Ok(None) };
        let frame = flow_files::read_frame(&found)?;
        if (frame.width() as usize, frame.height() as usize) != (field.width, field.height) {
            let (width, height) = frame.dimensions();
            bail!("{}: expected {}×{} as the flow, found {width}×{height}", found.display(), field.width, field.height);
        }
        Ok(Some(frame))
    };
    let frames = [("older frame", beside(&args.image1, "img1")?), ("newer frame", beside(&args.image2, "img2")?)];
    let unknown = |field: &Field| -> Vec<[f32; 2]> {
        (0..field.vectors.len()).map(|i| if field.known(i) { field.vectors[i] } else { [f32::NAN; 2] }).collect()
    };
    let truth = match &args.truth {
        Some(at) => {
            let truth = flow_files::read(at)?;
            if (truth.width, truth.height) != (field.width, field.height) {
                let (width, height) = (truth.width, truth.height);
                bail!(
                    "{}: expected {}×{} as the flow, found {width}×{height}",
                    at.display(),
                    field.width,
                    field.height
                );
            }
            Some(unknown(&truth))
        }
        None => None,
    };
    let mut plate = Plate {
        title: format!("{name}, {}x{}", field.width, field.height),
        frames: frames.into_iter().filter_map(|(title, frame)| Some((title, frame?))).collect(),
        grid: [field.width, field.height],
        flow: unknown(field),
        flow_title: "optical flow",
        truth,
        seen: beside(&None, "valid")?.map(|mask| mask.pixels().map(|pixel| pixel.0[0] > 127).collect()),
        name: name.clone(),
        ..Plate::default()
    };
    let errors = summed(&plate.errors());
    plate.lines = lines(field, errors);
    Ok((Row { name, errors, ..Row::default() }, plate))
}

fn lines(field: &Field, errors: Option<[f32; 2]>) -> Vec<String> {
    let mut lengths: Vec<f32> = (0..field.vectors.len())
        .filter(|i| field.known(*i))
        .map(|i| field.vectors[i][0].hypot(field.vectors[i][1]))
        .collect();
    lengths.sort_by(f32::total_cmp);
    let mut lines = Vec::new();
    if let (Some(longest), count) = (lengths.last(), lengths.len()) {
        let mean = lengths.iter().map(|length| f64::from(*length)).sum::<f64>() / count as f64;
        lines.push(format!("displacement mean {mean:.2}, median {:.2}, longest {longest:.1} px", lengths[count / 2]));
    }
    if let Some([mean, ninth]) = errors {
        lines.push(format!("EPE {mean:.3} px, 90 % below {ninth:.2} px"));
    }
    lines
}
