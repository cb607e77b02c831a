"""Ways to damage a file of a data set: each makes a function of the folder that holds it."""

import json
import pickle
import zipfile

import numpy as np


def bytes_of(path, change):
    return lambda folder: (folder / path).write_bytes(change((folder / path).read_bytes()))


def removed(path):
    return lambda folder: (folder / path).unlink()


def a_folder(path):
    def damage(folder):
        (folder / path).unlink()
        (folder / path).mkdir()

    return damage


def text(path, old, new):
    def damage(folder):
        content = (folder / path).read_text()
        assert old in content
        (folder / path).write_text(content.replace(old, new, 1))

    return damage


def npz(path, **changes):
    """Entries replaced by a function of them; None removes one."""

    def damage(folder):
        values = dict(np.load(folder / path))
        values |= {key: change(values[key]) for key, change in changes.items() if change}
        kept = {key: x for key, x in values.items() if key not in changes or changes[key]}
        np.savez(folder / path, **kept)

    return damage


def pkl(path, **changes):
    def damage(folder):
        values = pickle.loads((folder / path).read_bytes())
        values |= {key: change(values[key]) for key, change in changes.items() if change}
        kept = {key: x for key, x in values.items() if key not in changes or changes[key]}
        (folder / path).write_bytes(pickle.dumps(kept))

    return damage


def jsn(path, change):
    def damage(folder):
        content = json.loads((folder / path).read_text())
        change(content)
        (folder / path).write_text(json.dumps(content))

    return damage


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
    def damage(folder):
        values = dict(np.load(folder / path))
        values[key] = np.asarray([Evil()], object)
        np.savez(folder / path, **values)

    return damage


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


def pkl_at(folder, path, **values):
    content = pickle.loads((folder / path).read_bytes())
    (folder / path).write_bytes(pickle.dumps(content | values))


def scale_obj(path, factor):
    lines = [line.split() for line in path.read_text().splitlines()]
    scaled = [[w[0], *(str(factor * float(x)) for x in w[1:])] if w[0] == "v" else w for w in lines]
    path.write_text("\n".join(" ".join(words) for words in scaled))


def swap_npz(path, one, other):
    values = dict(np.load(path))
    np.savez(path, **(values | {one: values[other], other: values[one]}))
