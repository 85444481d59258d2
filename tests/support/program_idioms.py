"""Idioms of the programs that language models write, by name: those that run as in Python, and those that are refused.

Both lists were written down from what VoxPoser's prompt files show models (observations unpacked from boxes, maps written
by index, slice and mask, f-strings in queries, loops over found objects, comments and imports at the top) and from what
models add to that on their own (helper functions, error handling, sorting by a key, spheres from index grids).
"""

from __future__ import annotations

IDIOMS: dict[str, str] = {
    # Functions
    "a helper function with a default": "def up(z, by=5):\n    return z + by\nx = up(3), up(3, 7), up(z=1, by=2)",
    "a lambda kept in a variable": "square = lambda v: v ** 2\nx = square(7)",
    "an early return in a loop": "def first(xs):\n    for v in xs:\n        if v > 2:\n            return v\n    return None\nx = first([1, 3, 5]), first([])",
    "several results as a tuple": "def ends(xs):\n    return min(xs), max(xs)\nlow, high = ends([3, 1, 2])",
    "bounded recursion": "def fact(n):\n    if n <= 1:\n        return 1\n    return n * fact(n - 1)\nx = fact(12)",
    "recursion over nested lists": "def flat(v):\n    return [v] if not isinstance(v, list) else [w for u in v for w in flat(u)]\nx = flat([1, [2, [3, [4]]]])",
    "a closure": "def adder(n):\n    def add(v):\n        return v + n\n    return add\nx = adder(3)(4)",
    "a counter with nonlocal": "def counter():\n    n = 0\n    def step():\n        nonlocal n\n        n += 1\n        return n\n    return step\nc = counter()\nx = [c(), c(), c()]",
    "a global counter": "total = 0\ndef add(v):\n    global total\n    total += v\nfor v in [1, 2, 3]:\n    add(v)",
    "a default that is shared between calls": "def keep(v, seen=[]):\n    seen.append(v)\n    return list(seen)\nx = keep(1), keep(2)",
    "any number of arguments": "def f(a, *rest, scale=1, **more):\n    return a, rest, scale, sorted(more)\nx = f(1, 2, 3, scale=4, z=5, y=6)",
    "arguments from a list and a dictionary": "def f(a, b, c=0):\n    return a, b, c\nx = f(*[1, 2], **{'c': 3})",
    "positional and keyword-only parameters": "def f(a, /, b, *, c):\n    return a, b, c\nx = f(1, b=2, c=3)",
    "a function given to a function": "def twice(f, v):\n    return f(f(v))\nx = twice(lambda v: v + 3, 1)",
    "functions in a dictionary": "ops = {'add': lambda a, b: a + b, 'mul': lambda a, b: a * b}\nx = ops['add'](2, 3), ops['mul'](2, 3)",
    "late binding in closures": "fs = [lambda: i for i in range(3)]\nx = [f() for f in fs]\nfs = [lambda i=i: i for i in range(3)]\ny = [f() for f in fs]",
    "a docstring and type hints": 'def f(v: int, w: "list[float]" = None) -> tuple[int, int]:\n    """Double it."""\n    y: int = v * 2\n    return v, y\nx: tuple = f(2)',
    # Generators
    "a generator function": "def evens(n):\n    for i in range(n):\n        if i % 2 == 0:\n            yield i\nx = list(evens(7))\ny = sum(evens(7))",
    "the first match of a generator expression": "x = next((v for v in [1, 4, 9] if v > 3), None)\ny = next((v for v in [1] if v > 3), 'none')",
    "a generator without an end, cut off": "def count():\n    n = 0\n    while True:\n        yield n\n        n += 1\nx = [v for v, _ in zip(count(), range(4))]",
    "yield from": "def inner():\n    yield 1\n    yield 2\ndef outer():\n    yield from inner()\n    yield 3\nx = list(outer())",
    "a generator with an error inside": "def g():\n    try:\n        yield 1\n        yield 1 // 0\n    except ZeroDivisionError:\n        yield -1\nx = list(g())",
    "iterators are used up": "z = zip([1, 2], [3, 4])\nx = list(z)\ny = list(z)\nit = iter([1, 2, 3])\nw = next(it), list(it)",
    # Comprehensions
    "comprehensions of all kinds": "x = [i * j for i in range(3) for j in range(i)]\ny = {k: v for k, v in zip('ab', [1, 2])}\nz = {v % 3 for v in range(9)}\nw = tuple(v for v in [1, 2])",
    "a comprehension keeps its names to itself": "v = 7\nx = [v for v in range(3)]\ny = v",
    "an assignment expression": "x = [y for v in [1, 2, 3] if (y := v * v) > 2]\nif (n := len(x)) > 1:\n    z = n",
    "nested comprehensions": "x = [[i + j for j in range(2)] for i in range(2)]\ny = [a for row in x for a in row]",
    # Errors
    "try and except": "try:\n    x = 1 / 0\nexcept ZeroDivisionError:\n    x = 0",
    "except with a tuple, else and finally": "log = []\nfor v in ['1', 'a']:\n    try:\n        log.append(int(v))\n    except (ValueError, TypeError):\n        log.append('bad')\n    else:\n        log.append('good')\n    finally:\n        log.append('end')",
    "the message of an error": "try:\n    raise ValueError('too far')\nexcept ValueError as e:\n    x = str(e)\n    y = f'failed: {e}'\n    z = isinstance(e, Exception)",
    "raise again": "x = []\ntry:\n    try:\n        raise KeyError('k')\n    except KeyError:\n        x.append(1)\n        raise\nexcept LookupError:\n    x.append(2)",
    "raise from, and a class without a message": "x = 0\ntry:\n    try:\n        [][1]\n    except IndexError as e:\n        raise RuntimeError from e\nexcept RuntimeError as e:\n    x = 1",
    "finally before return": "log = []\ndef f():\n    try:\n        return 1\n    finally:\n        log.append('closed')\nx = f()",
    "a missing key": "d = {'a': 1}\ntry:\n    x = d['b']\nexcept KeyError:\n    x = d.get('b', 0)",
    "assert with a message": "try:\n    assert 1 > 2, 'one is less'\nexcept AssertionError as e:\n    x = str(e)",
    "except without a class": "try:\n    x = undefined_name\nexcept:\n    x = 'fallback'",
    "an own error passes through a function": "def check(v):\n    if v < 0:\n        raise ValueError(f'{v} is negative')\n    return v\nx = []\nfor v in [1, -1]:\n    try:\n        x.append(check(v))\n    except ValueError as error:\n        x.append(str(error))",
    # Text
    "f-strings with formats": "v, w = 3.14159, 42\nx = f'{v:.2f}|{w:05d}|{w:>6}|{\"a\":<3}|{v:+.1e}|{w:,}|{0.25:.0%}|{\"b\"!r}|{w:x}'",
    "an f-string with a computed width": "v, n = 2.5, 3\nx = f'{v:.{n}f}' + f'{v!s:>{n + 3}}' + f'{n=}'",
    "str.format": "x = '{} and {}'.format(1, 'b')\ny = '{1} {0} {name}'.format(1, 2, name='c')\nz = '{:.2f} {:>4} {:{w}}'.format(1.5, 'a', 7, w=3)\nw = '{{}} {!r}'.format('q')",
    "percent formats": "x = '%s at %d, %.2f, 100%%' % ('bowl', 7, 0.5)\ny = '%5s|%-5s|%05.1f' % ('a', 'b', 2.25)\nz = 'only %s' % 3\nw = '%(k)s' % {'k': 'v'}",
    "methods of text": "s = ' Top Drawer_1 '\nx = s.strip().lower().replace('_', ' ').split()\ny = s.strip().startswith(('Top', 'Low')), 'drawer_1'.rsplit if False else 0\nz = '-'.join(x), s.strip().partition(' '), 'a1'.isalnum(), '12'.isdigit()",
    "text by index and slice": "s = 'akita_black_bowl_1'\nx = s[0], s[-1], s[:5], s[::-1], s[:-2]\ny = [c for c in s if c == 'b']\nz = 'bowl' in s and not s.endswith('x')",
    # Loops and order
    "enumerate, zip and items": "x = []\nfor i, (k, v) in enumerate(zip(['a', 'b'], [1, 2]), 1):\n    x.append((i, k, v))\ny = [f'{k}{v}' for k, v in {'a': 1}.items()]",
    "sorted by a key": "cups = [('a', 3), ('b', 1), ('c', 2)]\nx = sorted(cups, key=lambda c: c[1])\ny = sorted(cups, key=lambda c: (-c[1], c[0]), reverse=True)[0][0]\ncups.sort(key=lambda c: c[0], reverse=True)",
    "min and max by a key": "ps = {'a': [1, 2], 'b': [0, 5]}\nx = min(ps, key=lambda k: ps[k][0])\ny = max(ps.values(), key=sum)\nz = max([], default=None), min(3, 1, key=lambda v: -v)",
    "map, filter, any and all": "x = list(map(int, ['1', '2']))\ny = list(filter(None, [0, 1, 2]))\nz = any(v > 1 for v in x), all(map(bool, x))\nw = list(map(lambda a, b: a * b, x, [3, 4]))",
    "reversed, range and round": "x = list(reversed(range(3))), list(range(5, 0, -2))\ny = round(2.675, 2), round(7.5), abs(-2)\nz = divmod(7, 2), pow(2, 5), sum([1, 2], 10)",
    "while with else and break": "n = 7\nwhile n > 1:\n    n -= 2\n    if n == 3:\n        break\nelse:\n    n = 100\nfor v in []:\n    pass\nelse:\n    m = 1",
    "chained comparisons and conditional expressions": "v = 5\nx = 1 < v <= 5 != 6\ny = 'big' if v > 3 else 'small'\nz = v if v is not None else 0",
    "starred names": "first, *rest = [1, 2, 3]\n*init, last = 'abc'\na, (b, *c), d = 1, [2, 3, 4], 5\nx = [*rest, *init], {**{'k': 1}, 'l': 2}, (*rest, 0)",
    "swapping and chained assignment": "a, b = 1, 2\na, b = b, a\nx = y = []\nx.append(a)\nz = (1,)\nz += (2,)",
    "augmented assignment everywhere": "d = {'n': 1}\nd['n'] += 4\nxs = [1, 2, 3]\nxs[1] *= 10\nn = 7\nn //= 2\nn **= 2\nn %= 5\nn |= 8",
    "lists": "x = [3, 1]\nx.append(2)\nx.extend([5, 4])\nx.insert(0, 9)\nx.remove(5)\ny = x.pop(0), x.index(2), x.count(1)\nx.sort()\nx[1:2] = [7, 8]\ndel x[0]\nz = x[-2:], x[::2], x.copy()\nx.clear()",
    "dictionaries": "d = dict(a=1, b=2)\nd.update({'c': 3})\nx = d.pop('a'), d.setdefault('e', []), d.get('z'), 'b' in d, len(d), list(d)\ndel d['b']\nfor k, v in d.items():\n    last = k\ny = {**d} | {'q': 1}",
    "sets": "s = {3, 1, 2}\ns.add(5)\ns.discard(9)\nx = sorted(s | {7}), s & {1, 2}, s - {1}, len(set([1, 1])), 3 in s\ny = set('aab') == {'a', 'b'}",
    "isinstance and len": "x = [isinstance(v, kind) for v, kind in [(1, int), (1.5, float), ('a', str), ([], (list, tuple)), ({}, dict), (True, int)]]\ny = len([1, 2]), len('abc'), len({})",
    "a name deleted": "v = 1\ndel v\ntry:\n    v\nexcept NameError:\n    x = 'gone'",
    "print and pass": "print('moving', 1, sep=', ')\nfor _ in range(2):\n    pass\nx = print()",
    "a name with an underscore": "_tmp = 3\ndef _helper(_v):\n    return _v + _tmp\nx = _helper(1)",
    # Imports that bring nothing new
    "import numpy as np": "import numpy as np\nx = float(np.sqrt(16)), np.pi\ndel np",
    "from numpy import": "from numpy import pi, array as arr\nx = pi, arr([1, 2]).tolist()\ndel arr",
    "import math": "import math\nx = math.sqrt(9), math.floor(2.7), math.pi, math.hypot(3, 4), math.radians(180) == math.pi\ndel math",
    "from math import and typing": "from math import sin, cos as c\nfrom typing import List, Optional\nx = sin(0), c(0)\ndef f(v: Optional[List[int]] = None):\n    return v\ndel sin, c",
    "copy": "import copy\na = [[1], 2]\nb = copy.deepcopy(a)\nb[0].append(5)\nx = a\ndel copy",
}

# Idioms that only run here: they use the given functions or the leniency of maps. The source, and what `x` is then.
GIVEN: dict[str, tuple[str, object]] = {
    "imports of the prompts": (
        "import numpy as np\nfrom env_utils import execute, reset_to_default_pose\n"
        "from perception_utils import parse_query_obj, detect\nfrom plan_utils import get_map, cm2index as c2i\n"
        "from utils import get_clock_time, normalize_vector, pointat2quat, bcolors, Observation\n"
        "from transforms3d.euler import euler2quat, quat2euler\nfrom transforms3d.quaternions import qmult, qinverse\n"
        "x = c2i(10, 'z')",
        5,
    ),
    "a module of the prompts": ("import perception_utils as p\nimport plan_utils\nx = p.detect('bowl').name, plan_utils.cm2index(4, 'x')", ("bowl", 2)),
    "corners of a box": (
        "bowl = detect('bowl')\n(min_x, min_y, min_z), (max_x, max_y, max_z) = bowl.aabb\n"
        "center_x, center_y, center_z = bowl.position\nx = [int(v) for v in (min_x, max_y, max_z + cm2index(10, 'z'), center_x)]",
        [15, 35, 49, 20],
    ),
    "a query with a position in it": ("x = f'a point 10cm in front of {detect(\"bowl\").position}'", "a point 10cm in front of [20 30 40]"),
    "an observation is called for its state": ("x = detect('bowl')().name", "bowl"),
    "an observation by key, or without it": (
        "b = detect('bowl')\ntry:\n    v = b['colour']\nexcept AttributeError:\n    v = 'none'\nx = v, b['held']",
        ("none", False),
    ),
    "a thing that is not there": (
        "def find(*names):\n    for name in names:\n        try:\n            return detect(name)\n        except Exception as e:\n            print(e)\n    return None\n"
        "x = find('cup', 'bowl').name",
        "bowl",
    ),
    "a function of the host as a key": ("x = sorted([3, 1, 2], key=lambda v: cm2index(v * 2, 'x')), list(map(detect, ['bowl']))[0].name", ([1, 2, 3], "bowl")),
    "a sphere from index grids": (
        "m = get_map()\ngx, gy, gz = np.meshgrid(np.arange(100), np.arange(100), np.arange(100), indexing='ij')\n"
        "m[(gx - 50) ** 2 + (gy - 50) ** 2 + (gz - 50) ** 2 <= 2 ** 2] = 1\nx = int(m.sum())",
        33,
    ),
    "a ball from an open grid": ("a, b, c = np.ogrid[:100, :100, :100]\nx = int(((a - 5) ** 2 + (b - 5) ** 2 + (c - 5) ** 2 < 2).sum())", 7),
    "half of a map by a slice": ("m = get_map()\ncx, cy, cz = detect('bowl').position\nm[:, cy:, :] = 0.5\nm[:cx] = 2\nx = float(m[0, 0, 0]), float(m[99, 99, 0]), float(m[99, 0, 0])", (2.0, 0.5, 0.0)),
    "the nearest of several": (
        "p = np.array([0, 0, 0])\nqs = [np.array([3, 4, 0]), np.array([1, 0, 0])]\n"
        "x = int(np.argmin([np.linalg.norm(q - p) for q in qs])), float(min(qs, key=lambda q: np.linalg.norm(q - p))[0])",
        (1, 1.0),
    ),
    "a nested helper that returns a map": (
        "def ball(m, at, r=1):\n    a, b, c = at\n    m[a - r:a + r + 1, b - r:b + r + 1, c - r:c + r + 1] = 1\n    return m\nx = int(ball(get_map(), detect('bowl').position, r=2).sum())",
        125,
    ),
}

# Idioms that are refused: the source, the rule, and words of the sentence that says what to write instead.
REFUSED: dict[str, tuple[str, str, str]] = {
    "with": ("with open('f') as f:\n    pass", "definitions", "write its body alone"),
    "a class": ("class Box:\n    pass", "definitions", "write functions"),
    "a decorator": ("@cache\ndef f():\n    pass", "definitions", "call the function on the value"),
    "async": ("async def f():\n    pass", "definitions", "write def"),
    "match": ("match 1:\n    case 1:\n        pass", "syntax", "write if, elif and else"),
    "a shift": ("x = 1 << 3", "syntax", "multiply or divide by a power of two"),
    "type()": ("x = type(1) == int", "names", "compare with isinstance"),
    "getattr": ("x = getattr(detect('bowl'), 'position')", "names", "x['name']"),
    "open": ("x = open('file')", "names", "programs have no files"),
    "exit": ("exit()", "names", "end the program with return"),
    "the time": ("import time\ntime.sleep(1)", "imports", "programs do not see the time"),
    "a clock": ("from utils import get_clock_time\nx = get_clock_time()", "names", "leave it out"),
    "random numbers": ("import random", "imports", "same result each time"),
    "numpy's random numbers": ("x = np.random.rand()", "names", "same result each time"),
    "scipy": ("from scipy.ndimage import distance_transform_edt", "imports", "set_voxel_by_radius"),
    "itertools": ("import itertools", "imports", "write loops or comprehensions"),
    "yield in an expression": ("def f():\n    x = [(yield 1)]", "syntax", "statement of its own"),
    "a format that walks": ("x = '{0.position}'.format(detect('bowl'))", "formats", "give that value to format()"),
    "a function for the host": ("detect(lambda: 'bowl')", "types", "give what it returns"),
    "an array as a condition": ("if np.zeros(3):\n    pass", "types", ".any() or .all()"),
    "arrays put in order": ("x = sorted([np.zeros(3), np.ones(3)])", "types", "key="),
    "a range for the host": ("detect([range(3)])", "types", "list(range(...))"),
    "an iterator as numbers": ("x = np.array(v for v in [1])", "types", "expected numbers"),
    "text added up": ("x = sum(['a', 'b'], '')", "types", "''.join"),
}
