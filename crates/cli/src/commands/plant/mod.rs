//! `nesam plant`: the simulated vehicle that closed-loop runs drive.

mod check;
pub mod write;

use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::sync::Arc;

use clap::{Args, Subcommand};
use nesam_model::bundle::sha256_hex;
use nesam_plant::{EFFECTS, Ground, HiddenEffects, Plant, PlantServer, PlantVehicle, Sensors};

use crate::args::DataArgs;
use crate::failure::{Failure, OrFail};
use crate::output::say;
use crate::sources::open_root;

/// Steps at rest and of straight acceleration before a drive begins.
const BEFORE: [usize; 2] = [10, 15];

/// Options of `nesam plant`.
#[derive(Args, Debug)]
pub struct PlantArgs {
    #[command(subcommand)]
    command: PlantCommand,
}

#[derive(Subcommand, Debug)]
enum PlantCommand {
    /// Give the plant the commands of recorded drives, on their map and true soil, and compare
    Check(check::CheckArgs),
    /// Write drives of the plant, with hidden effects where asked for, as a data root
    Write(write::WriteArgs),
    /// Answer the plant protocol over UDP (docs/plant-adapter.md) until interrupted
    Serve(ServeArgs),
    /// List the hidden effects with their admitted magnitudes
    Effects,
}

/// Options of `nesam plant serve`.
#[derive(Args, Debug)]
struct ServeArgs {
    /// Data root with the vehicle's data sheet and worlds with true soil [default: the sample shipped with the repository]
    #[arg(long, value_name = "ROOT")]
    data: Option<PathBuf>,
    /// Address to listen on; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:5599")]
    listen: SocketAddr,
    /// Hidden effect of the vehicle; may be given several times
    #[arg(long, value_name = "ID=MAGNITUDE")]
    effect: Vec<String>,
}

/// Runs the command.
pub fn run(args: &PlantArgs) -> Result<(), Failure> {
    match &args.command {
        PlantCommand::Check(args) => check::run(args),
        PlantCommand::Write(args) => write::run(args),
        PlantCommand::Serve(args) => serve(args),
        PlantCommand::Effects => {
            for effect in &EFFECTS {
                say!("{:<20} {} to {}", effect.id, effect.range[0], effect.range[1]);
            }
            Ok(())
        }
    }
}

/// The data root of a subcommand.
fn root_of(data: Option<&PathBuf>) -> Result<PathBuf, Failure> {
    open_root(&DataArgs::of(data.cloned())).map(|(_, path)| path)
}

fn effects_of(given: &[String]) -> Result<HiddenEffects, Failure> {
    HiddenEffects::parse(given.iter().map(String::as_str)).or_input()
}

fn serve(args: &ServeArgs) -> Result<(), Failure> {
    let (data, root) = open_root(&DataArgs::of(args.data.clone()))?;
    let effects = effects_of(&args.effect)?;
    let vehicle = Arc::new(PlantVehicle::of_root(&root).or_input()?);
    let mut known: Option<(String, Arc<Ground>)> = None;
    let hidden = if args.effect.is_empty() { "no hidden effect".to_string() } else { args.effect.join(" ") };
    let card = sha256_hex(&std::fs::read(data.card()).or_input()?);
    let name = format!("nesam plant {}, {hidden}, card {}", env!("CARGO_PKG_VERSION"), &card[..12]);
    let mut server = PlantServer::new(name, move |world, seed, [x, y, yaw]| {
        // The name becomes part of a path: only what a world folder is called.
        if world.is_empty() || !world.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-') {
            return Err(format!("`{world}` is no name of a world"));
        }
        let ground = match &known {
            Some((id, ground)) if id == world => Arc::clone(ground),
            _ => Arc::new(Ground::read(&root.join("worlds").join(world)).map_err(|e| e.to_string())?),
        };
        known = Some((world.into(), Arc::clone(&ground)));
        Ok((Plant::at_rest(Arc::clone(&vehicle), ground, effects, x, y, yaw), Sensors::new(seed, &effects)))
    });
    let socket = UdpSocket::bind(args.listen).or_input()?;
    say!("plant {}", socket.local_addr().or_failed()?);
    server.run(&socket).or_failed()
}
