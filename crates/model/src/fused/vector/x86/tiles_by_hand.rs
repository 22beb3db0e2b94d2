//! Tiles done by hand: every instruction of AMX that the processor refuses is carried out here as its manual says. For tests on processors without tiles: what is
//! executed is the code that is shipped, so a wrong address, stride, count or layout shows.

use core::cell::UnsafeCell;
use core::mem;

use super::*;

/// A tile of sixteen rows of 64 bytes.
type Bytes = [[u8; 64]; LANES];

/// The registers; none before shapes were loaded.
struct Tiles(UnsafeCell<Option<[Bytes; 8]>>);

// SAFETY: one test uses it, in one thread.
unsafe impl Sync for Tiles {}

static TILES: Tiles = Tiles(UnsafeCell::new(None));

fn f32_of(bytes: &Bytes, row: usize, column: usize) -> f32 {
    f32::from_le_bytes(bytes[row][4 * column..][..4].try_into().expect("four bytes"))
}

fn bf16_of(bytes: &Bytes, row: usize, column: usize) -> f32 {
    f32::from_bits(u32::from(u16::from_le_bytes(bytes[row][2 * column..][..2].try_into().expect("two bytes"))) << 16)
}

/// c += a b as the manual has it: rows of `b` are pairs of rows of the matrix that it stands for.
fn multiply(c: &mut Bytes, a: &Bytes, b: &Bytes) {
    for m in 0..LANES {
        let mut apart = [0.0f32; 2 * LANES];
        for k in 0..LANES {
            for n in 0..2 * LANES {
                apart[n] += bf16_of(a, m, 2 * k + n % 2) * bf16_of(b, k, n);
            }
        }
        for n in 0..LANES {
            let sum = f32_of(c, m, n) + (apart[2 * n] + apart[2 * n + 1]);
            c[m][4 * n..][..4].copy_from_slice(&sum.to_le_bytes());
        }
    }
}

/// Carries out the instruction at `code` and returns its length; none where it is not one of tiles.
///
/// # Safety
/// `code` points at an instruction of this program, and its operands lie where they say.
unsafe fn carry_out(code: *const u8, register: impl Fn(usize) -> u64) -> Option<usize> {
    let at = |i: usize| unsafe { code.add(i).read() };
    if at(0) != 0xc4 || at(1) & 0x1f != 2 {
        return None;
    }
    let (not_rxb, vex, opcode, modrm) = (at(1) >> 5, at(2), at(3), at(4));
    let (mode, reg, rm) = (modrm >> 6, usize::from(modrm >> 3 & 7), usize::from(modrm & 7));
    let extended = |low: usize, bit: u8| if not_rxb & bit == 0 { low + 8 } else { low };
    // Where a memory operand begins, the stride of its rows and the length of the whole instruction.
    let operand = || {
        let (base, index, mut length) = if rm == 4 {
            let sib = at(5);
            let index = usize::from(sib >> 3 & 7);
            assert_eq!(sib >> 6, 0, "strides are not scaled here");
            let stride = if index == 4 && not_rxb & 2 != 0 { 0 } else { register(extended(index, 2)) };
            (extended(usize::from(sib & 7), 1), stride, 6)
        } else {
            (extended(rm, 1), 0, 5)
        };
        let displacement = match mode {
            0 => 0,
            1 => {
                length += 1;
                i64::from(at(length - 1).cast_signed())
            }
            _ => {
                length += 4;
                i64::from(i32::from_le_bytes(core::array::from_fn(|i| at(length - 4 + i))))
            }
        };
        (register(base).wrapping_add_signed(displacement), index, length)
    };
    // SAFETY: only this thread uses the tiles.
    let tiles = unsafe { &mut *TILES.0.get() };
    let in_use = |tiles: &mut Option<[Bytes; 8]>| -> *mut [Bytes; 8] { tiles.as_mut().expect("tiles have shapes before they are used") };
    match (opcode, vex, mode) {
        (0x49, 0x78, 3) => {
            *tiles = None;
            Some(5)
        }
        (0x49, 0x78, _) => {
            let (from, _, length) = operand();
            let shapes = unsafe { (from as *const [u8; 64]).read() };
            assert_eq!(shapes[0], 1, "palette");
            assert!(shapes[1..16].iter().all(|byte| *byte == 0) && shapes[32..48].iter().all(|byte| *byte == 0));
            assert!((0..8).all(|t| shapes[16 + 2 * t] == 64 && shapes[17 + 2 * t] == 0 && shapes[48 + t] == 16));
            assert!(shapes[56..].iter().all(|byte| *byte == 0));
            *tiles = Some([[[0; 64]; LANES]; 8]);
            Some(length)
        }
        (0x49, 0x7b, 3) => {
            unsafe { (*in_use(tiles))[reg] = [[0; 64]; LANES] };
            Some(5)
        }
        (0x4b, 0x7a | 0x7b, _) => {
            let (start, stride, length) = operand();
            let tile = unsafe { &mut (&mut *in_use(tiles))[reg] };
            for (row, bytes) in tile.iter_mut().enumerate() {
                let memory = (start + row as u64 * stride) as *mut [u8; 64];
                match vex {
                    0x7b => *bytes = unsafe { memory.read() },
                    _ => unsafe { memory.write(*bytes) },
                }
            }
            Some(length)
        }
        (0x5c, _, 3) if vex & 0x87 == 0x02 => {
            let (b, a) = (usize::from(!vex >> 3 & 7), rm);
            let tiles = unsafe { &mut *in_use(tiles) };
            let (a, b) = (tiles[a], tiles[b]);
            multiply(&mut tiles[reg], &a, &b);
            Some(5)
        }
        _ => None,
    }
}

/// What the system calls when the processor refuses an instruction.
extern "C" fn refused(_: libc::c_int, _: *mut libc::siginfo_t, context: *mut libc::c_void) {
    use libc::{REG_R8, REG_RAX, REG_RBP, REG_RBX, REG_RCX, REG_RDI, REG_RDX, REG_RIP, REG_RSI, REG_RSP};
    // SAFETY: the system gives the state of the thread that it interrupted.
    let registers = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext.gregs };
    const LOW: [i32; 8] = [REG_RAX, REG_RCX, REG_RDX, REG_RBX, REG_RSP, REG_RBP, REG_RSI, REG_RDI];
    let register = |number: usize| {
        let at = if number < 8 { LOW[number] } else { REG_R8 + number as i32 - 8 };
        registers[at as usize].cast_unsigned()
    };
    let code = registers[REG_RIP as usize] as *const u8;
    // SAFETY: the processor was about to execute it.
    match unsafe { carry_out(code, register) } {
        Some(length) => registers[REG_RIP as usize] += length as i64,
        None => std::process::abort(),
    }
}

#[test]
fn analytic_products_of_tiles_are_those_in_f32() {
    if !has_avx512() {
        return;
    }
    let on_the_processor = has_amx();
    if !on_the_processor {
        // SAFETY: the handler does what its type says.
        unsafe {
            let mut action: libc::sigaction = mem::zeroed();
            action.sa_sigaction = refused as extern "C" fn(_, _, _) as usize;
            action.sa_flags = libc::SA_SIGINFO;
            assert_eq!(libc::sigaction(libc::SIGILL, &raw const action, core::ptr::null_mut()), 0);
        }
    }
    // The check that stands before every use of tiles in the service.
    assert!(unsafe { tiles_are_right() });
    let mut state = 7u32;
    let mut tile = || {
        Tile(core::array::from_fn(|_| {
            core::array::from_fn(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                // Numbers between 1/4 and 4 of both signs.
                let half = |bits: u32| (bits & 0x8000) | (0x3e80 + (bits & 0x1ff));
                half(state >> 16) | half(state >> 7) << 16
            })
        }))
    };
    for count in [1, 2, 4, 8] {
        let weights: Vec<[Tile; TILE_PANELS]> = (0..count).map(|_| core::array::from_fn(|_| tile())).collect();
        let inputs: Vec<Tile> = (0..count).map(|_| tile()).collect();
        for order in [Order::Tiles, Order::Pairs] {
            // SAFETY: the processor has AVX-512, and what it has not is done by hand.
            let [found, expected] = unsafe { on_amx(BothWays { order, weights: &weights, inputs: &inputs }) };
            assert_eq!(found, expected, "{count} tiles of inputs, {order:?}");
        }
    }
    if !on_the_processor {
        assert!(unsafe { (*TILES.0.get()).is_none() }, "tiles are given back");
        unsafe { libc::signal(libc::SIGILL, libc::SIG_DFL) };
    }
}
