"""Ways to damage a file of a data set: each makes a function of the folder that holds it."""

import pickle
import zipfile

import numpy as np
from changes import edit_bytes, edit_json, edit_npz, edit_pickle, edit_text


def bytes_of(path, change):
    return lambda folder: edit_bytes(folder / path, change)


def removed(path):
    return lambda folder: (folder / path).unlink()


def a_folder(path):
    def damage(folder):
        (folder / path).unlink()
        (folder / path).mkdir()

    return damage


def text(path, old, new):
    return lambda folder: edit_text(folder / path, old, new)


def npz(path, **changes):
    """Entries replaced by a function of them; None removes one."""
    return lambda folder: edit_npz(folder / path, **changes)


def pkl(path, **changes):
    return lambda folder: edit_pickle(folder / path, **changes)


def jsn(path, change):
    return lambda folder: edit_json(folder / path, change)


def spoiled(value, at=0):
    def change(array):
        array = array.copy()
        array.reshape(-1)[at] = value
        return array

    return change


class Evil:
    def __reduce__(self):
        import os

        return os.system, ("touch OWNED",)


def evil_pickle(folder_path):
    return lambda folder: (folder / folder_path).write_bytes(pickle.dumps({"betas": Evil()}))


def object_npz(path, key):
    return npz(path, **{key: np.asarray([Evil()], object)})


def bomb(path):
    """An archive of some 100 kB that unpacks to 2 GiB."""

    def damage(folder):
        header = (
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '|u1', 'fortran_order': False, 'shape': (2147483648,), }".ljust(117)
            + b"\n"
        )
        packed = zipfile.ZipFile(folder / path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        with packed as archive, archive.open("betas.npy", "w", force_zip64=True) as member:
            member.write(header)
            for _ in range(32):
                member.write(bytes(1 << 20))
        data = (folder / path).read_bytes()
        # the directory says more than there is: nothing has to be unpacked to refuse it
        size = (len(header) + (32 << 20)).to_bytes(4, "little")
        (folder / path).write_bytes(data.replace(size, (2147483648).to_bytes(4, "little")))

    return damage


def scale_obj(path, factor):
    lines = [line.split() for line in path.read_text().splitlines()]
    scaled = [[w[0], *(str(factor * float(x)) for x in w[1:])] if w[0] == "v" else w for w in lines]
    path.write_text("\n".join(" ".join(words) for words in scaled))


def swap_npz(path, one, other):
    values = dict(np.load(path))
    np.savez(path, **(values | {one: values[other], other: values[one]}))
