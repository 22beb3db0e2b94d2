//! `counted WORK TIMES` does one piece of work so many times; without arguments it lists them. What counts its instructions is
//! `tests/tools/instructions.py`.

use std::process::ExitCode;

use nesam_benches::WORKS;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let asked = match words.as_slice() {
        [] => {
            WORKS.iter().for_each(|(name, _)| println!("{name}"));
            return ExitCode::SUCCESS;
        }
        [name, times] => WORKS.iter().find(|(known, _)| known == name).zip(times.parse::<u32>().ok()),
        _ => None,
    };
    let Some(((_, make), times)) = asked else {
        eprintln!("usage: counted WORK TIMES, with a WORK that `counted` lists");
        return ExitCode::from(2);
    };
    let mut work = make();
    // Once before it is counted, as the first call makes ready what the others find.
    work();
    counted_work(&mut work, times);
    ExitCode::SUCCESS
}

/// What is counted, and nothing else: a function of its own, by whose name the counter is switched on and off.
#[inline(never)]
fn counted_work(work: &mut nesam_benches::Work, times: u32) {
    (0..times).for_each(|_| work());
}
