"""Synonyms of COCO's classes, for suggestions where a name is not known."""

_TABLE = """
person: man, men, woman, women, boy, girl, child, children, kid, baby, human, pedestrian, face, player, rider
bicycle: bike, cycle, push bike, mountain bike, tricycle
motorcycle: motor bike, bike, scooter, moped, vespa
car: automobile, auto, taxi, cab, suv, sedan, jeep, vehicle, minivan
truck: lorry, pickup, pickup truck, van, trailer, fire engine, vehicle
bus: coach, minibus, double decker, school bus, vehicle
airplane: plane, aircraft, jet, airliner, jumbo
train: tram, locomotive, railway, subway, metro, streetcar
boat: ship, sailboat, yacht, canoe, kayak, ferry, rowboat, vessel
traffic light: traffic signal, stop light, signal, traffic lamp
fire hydrant: hydrant
stop sign: traffic sign, road sign, sign
parking meter: meter
bench: park bench, pew
bird: pigeon, seagull, gull, duck, goose, parrot, eagle, crow, chicken, swan, sparrow, owl
cat: kitten, kitty
dog: puppy, hound, doggy
horse: pony, foal, mare, stallion
sheep: lamb, goat, ram, ewe
cow: cattle, bull, calf, ox, bison
bear: polar bear, grizzly, panda
backpack: rucksack, knapsack, bag, school bag
umbrella: parasol, sunshade
handbag: purse, bag, tote, shopping bag, clutch
tie: necktie, bow tie
suitcase: luggage, baggage, trunk, bag, briefcase
frisbee: disc, flying disc
sports ball: ball, football, soccer ball, tennis ball, basketball, baseball, volleyball
tennis racket: racket, racquet, tennis racquet
baseball glove: glove, mitt, baseball mitt
baseball bat: bat
bottle: water bottle, wine bottle, beer bottle, flask
wine glass: glass, goblet, champagne glass, flute
cup: mug, coffee cup, coffee mug, tea cup, glass, tumbler, beaker, paper cup
knife: blade, cutlery
fork: cutlery
spoon: ladle, teaspoon, cutlery
bowl: dish, basin
sandwich: burger, hamburger, toast, sub
orange: mandarin, tangerine, clementine
hot dog: sausage, frankfurter, wiener
donut: doughnut
cake: cupcake, muffin, pie, gateau, birthday cake
chair: seat, stool, armchair, office chair
couch: settee, loveseat, divan, sofa bed
potted plant: plant, house plant, flower pot, pot plant, flower
bed: mattress, bunk
dining table: table, desk, kitchen table, coffee table
toilet: lavatory, loo, wc, commode
tv: television, telly, monitor, screen, display, television set
laptop: notebook, computer, notebook computer, macbook
mouse: computer mouse
remote: remote control, clicker, game controller
keyboard: computer keyboard
cell phone: phone, mobile, mobile phone, smartphone, iphone, telephone, handy
microwave: microwave oven
oven: stove, cooker, range
sink: washbasin, basin, wash basin, tap, faucet
refrigerator: fridge, freezer, icebox
book: magazine, novel, paperback, notebook
clock: watch, wall clock, alarm clock
vase: urn, jar
scissors: shears
teddy bear: teddy, stuffed animal, plush, soft toy, toy
hair drier: hair dryer, blow dryer, hairdryer, dryer
"""


def _read(table: str) -> dict[str, tuple[str, ...]]:
    """Classes by each of their synonyms, which are written without spaces."""
    classes: dict[str, tuple[str, ...]] = {}
    for line in table.strip().splitlines():
        name, _, others = line.partition(": ")
        for other in others.split(", "):
            key = other.replace(" ", "")
            classes[key] = (*classes.get(key, ()), name)
    return classes


SYNONYMS = _read(_TABLE)
"""Names of COCO's classes by their synonyms, in lower case and without spaces.

>>> SYNONYMS["mug"], SYNONYMS["glass"]
(('cup',), ('wine glass', 'cup'))
"""


def names_of(name: str) -> tuple[str, ...]:
    """List the synonyms of a class, with spaces.

    Args:
        name: name of the class in COCO's spelling.

    Returns:
        The synonyms.

    >>> names_of("fork"), names_of("kite")
    (('cutlery',), ())
    """
    lines = (line.partition(": ") for line in _TABLE.strip().splitlines())
    return next((tuple(others.split(", ")) for word, _, others in lines if word == name), ())
