"""Idioms of the programs that language models write, by name: those that run as in Python, and those that are refused.

Both lists were written down from what VoxPoser's prompt files show models (observations unpacked from boxes, maps
written by index, slice and mask, f-strings in queries, loops over found objects, comments and imports at the top) and
from what models add to that on their own (helper functions, error handling, sorting by a key, spheres from index
grids).
"""

from __future__ import annotations

IDIOMS: dict[str, str] = {
    # Functions
    "a helper function with a default": """\
def up(z, by=5):
    return z + by
x = up(3), up(3, 7), up(z=1, by=2)
""",
    "a lambda kept in a variable": """\
square = lambda v: v ** 2
x = square(7)
""",
    "an early return in a loop": """\
def first(xs):
    for v in xs:
        if v > 2:
            return v
    return None
x = first([1, 3, 5]), first([])
""",
    "several results as a tuple": """\
def ends(xs):
    return min(xs), max(xs)
low, high = ends([3, 1, 2])
""",
    "bounded recursion": """\
def fact(n):
    if n <= 1:
        return 1
    return n * fact(n - 1)
x = fact(12)
""",
    "recursion over nested lists": """\
def flat(v):
    return [v] if not isinstance(v, list) else [w for u in v for w in flat(u)]
x = flat([1, [2, [3, [4]]]])
""",
    "a closure": """\
def adder(n):
    def add(v):
        return v + n
    return add
x = adder(3)(4)
""",
    "a counter with nonlocal": """\
def counter():
    n = 0
    def step():
        nonlocal n
        n += 1
        return n
    return step
c = counter()
x = [c(), c(), c()]
""",
    "a global counter": """\
total = 0
def add(v):
    global total
    total += v
for v in [1, 2, 3]:
    add(v)
""",
    "a default that is shared between calls": """\
def keep(v, seen=[]):
    seen.append(v)
    return list(seen)
x = keep(1), keep(2)
""",
    "any number of arguments": """\
def f(a, *rest, scale=1, **more):
    return a, rest, scale, sorted(more)
x = f(1, 2, 3, scale=4, z=5, y=6)
""",
    "arguments from a list and a dictionary": """\
def f(a, b, c=0):
    return a, b, c
x = f(*[1, 2], **{'c': 3})
""",
    "positional and keyword-only parameters": """\
def f(a, /, b, *, c):
    return a, b, c
x = f(1, b=2, c=3)
""",
    "a function given to a function": """\
def twice(f, v):
    return f(f(v))
x = twice(lambda v: v + 3, 1)
""",
    "functions in a dictionary": """\
ops = {'add': lambda a, b: a + b, 'mul': lambda a, b: a * b}
x = ops['add'](2, 3), ops['mul'](2, 3)
""",
    "late binding in closures": """\
fs = [lambda: i for i in range(3)]
x = [f() for f in fs]
fs = [lambda i=i: i for i in range(3)]
y = [f() for f in fs]
""",
    "a docstring and type hints": '''\
def f(v: int, w: "list[float]" = None) -> tuple[int, int]:
    """Double it."""
    y: int = v * 2
    return v, y
x: tuple = f(2)
''',
    # Generators
    "a generator function": """\
def evens(n):
    for i in range(n):
        if i % 2 == 0:
            yield i
x = list(evens(7))
y = sum(evens(7))
""",
    "the first match of a generator expression": """\
x = next((v for v in [1, 4, 9] if v > 3), None)
y = next((v for v in [1] if v > 3), 'none')
""",
    "a generator without an end, cut off": """\
def count():
    n = 0
    while True:
        yield n
        n += 1
x = [v for v, _ in zip(count(), range(4))]
""",
    "yield from": """\
def inner():
    yield 1
    yield 2
def outer():
    yield from inner()
    yield 3
x = list(outer())
""",
    "a generator with an error inside": """\
def g():
    try:
        yield 1
        yield 1 // 0
    except ZeroDivisionError:
        yield -1
x = list(g())
""",
    "iterators are used up": """\
z = zip([1, 2], [3, 4])
x = list(z)
y = list(z)
it = iter([1, 2, 3])
w = next(it), list(it)
""",
    # Comprehensions
    "comprehensions of all kinds": """\
x = [i * j for i in range(3) for j in range(i)]
y = {k: v for k, v in zip('ab', [1, 2])}
z = {v % 3 for v in range(9)}
w = tuple(v for v in [1, 2])
""",
    "a comprehension keeps its names to itself": """\
v = 7
x = [v for v in range(3)]
y = v
""",
    "an assignment expression": """\
x = [y for v in [1, 2, 3] if (y := v * v) > 2]
if (n := len(x)) > 1:
    z = n
""",
    "nested comprehensions": """\
x = [[i + j for j in range(2)] for i in range(2)]
y = [a for row in x for a in row]
""",
    # Errors
    "try and except": """\
try:
    x = 1 / 0
except ZeroDivisionError:
    x = 0
""",
    "except with a tuple, else and finally": """\
log = []
for v in ['1', 'a']:
    try:
        log.append(int(v))
    except (ValueError, TypeError):
        log.append('bad')
    else:
        log.append('good')
    finally:
        log.append('end')
""",
    "the message of an error": """\
try:
    raise ValueError('too far')
except ValueError as e:
    x = str(e)
    y = f'failed: {e}'
    z = isinstance(e, Exception)
""",
    "raise again": """\
x = []
try:
    try:
        raise KeyError('k')
    except KeyError:
        x.append(1)
        raise
except LookupError:
    x.append(2)
""",
    "raise from, and a class without a message": """\
x = 0
try:
    try:
        [][1]
    except IndexError as e:
        raise RuntimeError from e
except RuntimeError as e:
    x = 1
""",
    "finally before return": """\
log = []
def f():
    try:
        return 1
    finally:
        log.append('closed')
x = f()
""",
    "a missing key": """\
d = {'a': 1}
try:
    x = d['b']
except KeyError:
    x = d.get('b', 0)
""",
    "assert with a message": """\
try:
    assert 1 > 2, 'one is less'
except AssertionError as e:
    x = str(e)
""",
    "except without a class": """\
try:
    x = undefined_name
except:
    x = 'fallback'
""",
    "an own error passes through a function": """\
def check(v):
    if v < 0:
        raise ValueError(f'{v} is negative')
    return v
x = []
for v in [1, -1]:
    try:
        x.append(check(v))
    except ValueError as error:
        x.append(str(error))
""",
    # Text
    "f-strings with formats": """\
v, w = 3.14159, 42
x = f'{v:.2f}|{w:05d}|{w:>6}|{"a":<3}|{v:+.1e}|{w:,}|{0.25:.0%}|{"b"!r}|{w:x}'
""",
    "an f-string with a computed width": """\
v, n = 2.5, 3
x = f'{v:.{n}f}' + f'{v!s:>{n + 3}}' + f'{n=}'
""",
    "str.format": """\
x = '{} and {}'.format(1, 'b')
y = '{1} {0} {name}'.format(1, 2, name='c')
z = '{:.2f} {:>4} {:{w}}'.format(1.5, 'a', 7, w=3)
v = '{guard} {template} {value}'.format(guard=1, template=2, value=3)
w = '{{}} {!r}'.format('q')
""",
    "percent formats": """\
x = '%s at %d, %.2f, 100%%' % ('bowl', 7, 0.5)
y = '%5s|%-5s|%05.1f' % ('a', 'b', 2.25)
z = 'only %s' % 3
w = '%(k)s' % {'k': 'v'}
""",
    "methods of text": """\
s = ' Top Drawer_1 '
x = s.strip().lower().replace('_', ' ').split()
y = s.strip().startswith(('Top', 'Low')), 'drawer_1'.rsplit if False else 0
z = '-'.join(x), s.strip().partition(' '), 'a1'.isalnum(), '12'.isdigit()
""",
    "text by index and slice": """\
s = 'akita_black_bowl_1'
x = s[0], s[-1], s[:5], s[::-1], s[:-2]
y = [c for c in s if c == 'b']
z = 'bowl' in s and not s.endswith('x')
""",
    # Loops and order
    "enumerate, zip and items": """\
x = []
for i, (k, v) in enumerate(zip(['a', 'b'], [1, 2]), 1):
    x.append((i, k, v))
y = [f'{k}{v}' for k, v in {'a': 1}.items()]
""",
    "sorted by a key": """\
cups = [('a', 3), ('b', 1), ('c', 2)]
x = sorted(cups, key=lambda c: c[1])
y = sorted(cups, key=lambda c: (-c[1], c[0]), reverse=True)[0][0]
cups.sort(key=lambda c: c[0], reverse=True)
""",
    "min and max by a key": """\
ps = {'a': [1, 2], 'b': [0, 5]}
x = min(ps, key=lambda k: ps[k][0])
y = max(ps.values(), key=sum)
z = max([], default=None), min(3, 1, key=lambda v: -v)
""",
    "map, filter, any and all": """\
x = list(map(int, ['1', '2']))
y = list(filter(None, [0, 1, 2]))
z = any(v > 1 for v in x), all(map(bool, x))
w = list(map(lambda a, b: a * b, x, [3, 4]))
""",
    "reversed, range and round": """\
x = list(reversed(range(3))), list(range(5, 0, -2))
y = round(2.675, 2), round(7.5), abs(-2)
z = divmod(7, 2), pow(2, 5), sum([1, 2], 10)
""",
    "while with else and break": """\
n = 7
while n > 1:
    n -= 2
    if n == 3:
        break
else:
    n = 100
for v in []:
    pass
else:
    m = 1
""",
    "chained comparisons and conditional expressions": """\
v = 5
x = 1 < v <= 5 != 6
y = 'big' if v > 3 else 'small'
z = v if v is not None else 0
""",
    "starred names": """\
first, *rest = [1, 2, 3]
*init, last = 'abc'
a, (b, *c), d = 1, [2, 3, 4], 5
x = [*rest, *init], {**{'k': 1}, 'l': 2}, (*rest, 0)
""",
    "swapping and chained assignment": """\
a, b = 1, 2
a, b = b, a
x = y = []
x.append(a)
z = (1,)
z += (2,)
""",
    "augmented assignment everywhere": """\
d = {'n': 1}
d['n'] += 4
xs = [1, 2, 3]
xs[1] *= 10
same = xs
xs += 'ab'
xs += (v for v in range(2))
xs *= 2
n = 7
n //= 2
n **= 2
n %= 5
n |= 8
""",
    "lists": """\
x = [3, 1]
x.append(2)
x.extend([5, 4])
x.insert(0, 9)
x.remove(5)
y = x.pop(0), x.index(2), x.count(1)
x.sort()
x[1:2] = [7, 8]
del x[0]
z = x[-2:], x[::2], x.copy()
x.clear()
""",
    "dictionaries": """\
d = dict(a=1, b=2)
d.update({'c': 3}, value=4, given=5, guard=6, name=7)
for k in ('value', 'given', 'guard', 'name'):
    del d[k]
x = d.pop('a'), d.setdefault('e', []), d.get('z'), 'b' in d, len(d), list(d)
del d['b']
for k, v in d.items():
    last = k
y = {**d} | {'q': 1}
""",
    "sets": """\
s = {3, 1, 2}
s.add(5)
s.discard(9)
x = sorted(s | {7}), s & {1, 2}, s - {1}, len(set([1, 1])), 3 in s
y = set('aab') == {'a', 'b'}
""",
    "isinstance and len": """\
kinds = [(1, int), (1.5, float), ('a', str), ([], (list, tuple)), ({}, dict), (True, int)]
x = [isinstance(v, kind) for v, kind in kinds]
y = len([1, 2]), len('abc'), len({})
""",
    "a name deleted": """\
v = 1
del v
try:
    v
except NameError:
    x = 'gone'
""",
    "print and pass": """\
print('moving', 1, sep=', ')
for _ in range(2):
    pass
x = print()
""",
    "a name with an underscore": """\
_tmp = 3
def _helper(_v):
    return _v + _tmp
x = _helper(1)
""",
    # Imports that bring nothing new
    "import numpy as np": """\
import numpy as np
x = float(np.sqrt(16)), np.pi
del np
""",
    "from numpy import": """\
from numpy import pi, array as arr
x = pi, arr([1, 2]).tolist()
del arr
""",
    "import math": """\
import math
x = math.sqrt(9), math.floor(2.7), math.pi, math.hypot(3, 4), math.radians(180) == math.pi
del math
""",
    "from math import and typing": """\
from math import sin, cos as c
from typing import List, Optional
x = sin(0), c(0)
def f(v: Optional[List[int]] = None):
    return v
del sin, c
""",
    "copy": """\
import copy
a = [[1], 2]
b = copy.deepcopy(a)
b[0].append(5)
x = a
del copy
""",
}

# Idioms that only run here: they use the given functions or the leniency of maps. The source, and what `x` is then.
GIVEN: dict[str, tuple[str, object]] = {
    "imports of the prompts": (
        """\
import numpy as np
from env_utils import execute, reset_to_default_pose
from perception_utils import parse_query_obj, detect
from plan_utils import get_map, cm2index as c2i
from utils import get_clock_time, normalize_vector, pointat2quat, bcolors, Observation
from transforms3d.euler import euler2quat, quat2euler
from transforms3d.quaternions import qmult, qinverse
x = c2i(10, 'z')
""",
        5,
    ),
    "an argument by its name": ("x = detect(name='bowl').name", "bowl"),
    "a module of the prompts": (
        """\
import perception_utils as p
import plan_utils
x = p.detect('bowl').name, plan_utils.cm2index(4, 'x')
""",
        ("bowl", 2),
    ),
    "corners of a box": (
        """\
bowl = detect('bowl')
(min_x, min_y, min_z), (max_x, max_y, max_z) = bowl.aabb
center_x, center_y, center_z = bowl.position
x = [int(v) for v in (min_x, max_y, max_z + cm2index(10, 'z'), center_x)]
""",
        [15, 35, 49, 20],
    ),
    "a query with a position in it": (
        "x = f'a point 10cm in front of {detect(\"bowl\").position}'",
        "a point 10cm in front of [20 30 40]",
    ),
    "an observation is called for its state": ("x = detect('bowl')().name", "bowl"),
    "an observation by key, or without it": (
        """\
b = detect('bowl')
try:
    v = b['colour']
except AttributeError:
    v = 'none'
x = v, b['held']
""",
        ("none", False),
    ),
    "a thing that is not there": (
        """\
def find(*names):
    for name in names:
        try:
            return detect(name)
        except Exception as e:
            print(e)
    return None
x = find('cup', 'bowl').name
""",
        "bowl",
    ),
    "a function of the host as a key": (
        """\
x = sorted([3, 1, 2], key=lambda v: cm2index(v * 2, 'x')), list(map(detect, ['bowl']))[0].name
""",
        ([1, 2, 3], "bowl"),
    ),
    "a sphere from index grids": (
        """\
m = get_map()
gx, gy, gz = np.meshgrid(np.arange(100), np.arange(100), np.arange(100), indexing='ij')
m[(gx - 50) ** 2 + (gy - 50) ** 2 + (gz - 50) ** 2 <= 2 ** 2] = 1
x = int(m.sum())
""",
        33,
    ),
    "a ball from an open grid": (
        """\
a, b, c = np.ogrid[:100, :100, :100]
x = int(((a - 5) ** 2 + (b - 5) ** 2 + (c - 5) ** 2 < 2).sum())
""",
        7,
    ),
    "half of a map by a slice": (
        """\
m = get_map()
cx, cy, cz = detect('bowl').position
m[:, cy:, :] = 0.5
m[:cx] = 2
x = float(m[0, 0, 0]), float(m[99, 99, 0]), float(m[99, 0, 0])
""",
        (2.0, 0.5, 0.0),
    ),
    "the nearest of several": (
        """\
p = np.array([0, 0, 0])
qs = [np.array([3, 4, 0]), np.array([1, 0, 0])]
x = int(np.argmin([np.linalg.norm(q - p) for q in qs])), float(min(qs, key=lambda q: np.linalg.norm(q - p))[0])
""",
        (1, 1.0),
    ),
    "a nested helper that returns a map": (
        """\
def ball(m, at, r=1):
    a, b, c = at
    m[a - r:a + r + 1, b - r:b + r + 1, c - r:c + r + 1] = 1
    return m
x = int(ball(get_map(), detect('bowl').position, r=2).sum())
""",
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
