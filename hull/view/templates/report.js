// Scrubs a report: the timeline, the numbers and pictures of the chosen frame, and the scene in 3D.
// What it reads stands in the page: `told` (JSON), and packed numbers (hybridve.hull.view.packed).
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const told = JSON.parse(byId("told").textContent);
  const count = told.frames.length;
  const state = { row: -1, focus: null };

  // --- Reading what is packed -----------------------------------------------------------------

  async function inflated(text) {
    const bytes = Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }

  async function chunk(name) {
    const found = byId(name);
    return found === null ? null : inflated(found.textContent);
  }

  // Lists of ascending numbers: how long each is, then steps.
  function listsOf(buffer) {
    const counts = new Uint32Array(buffer, 0, count);
    const steps = new Uint32Array(buffer, 4 * count);
    const lists = [];
    let at = 0;
    for (let row = 0; row < count; row++) {
      const list = new Uint32Array(counts[row]);
      let value = 0;
      for (let k = 0; k < list.length; k++) {
        value += steps[at++];
        list[k] = value;
      }
      lists.push(list);
    }
    return lists;
  }

  // --- Words ----------------------------------------------------------------------------------

  // As hybridve.calib.lengths.bounds_mm: the digits that mean something, and how far off at most.
  function boundsText(lower, upper) {
    const half = 0.5 * (upper - lower);
    if (!Number.isFinite(upper)) return Number.isFinite(lower) ? `beyond ${lower.toFixed(1)}` : "-";
    if (!Number.isFinite(lower)) return `at most ${upper.toFixed(1)}`;
    if (half <= 0.0005) return String(Number(lower.toFixed(3)) + 0);
    const decimals = Math.min(Math.max(Math.floor(-Math.log10(half)), 0), 3);
    const scale = 10 ** decimals;
    const value = Math.round(0.5 * (lower + upper) * scale) / scale;
    const off = Math.ceil(scale * Math.max(upper - value, value - lower) - 1e-3) / scale;
    return `${(value + 0).toFixed(decimals)} ±${off.toFixed(decimals)}`;
  }

  // As hybridve.calib.lengths.at_least_mm: rounded down, as far as it is off the bound.
  function atLeastText(value, bound) {
    const decimals = value === 0 || bound - value >= 2 ? 0 : 1;
    const scale = 10 ** decimals;
    return (Math.floor(value * scale + 1e-3) / scale + 0).toFixed(decimals);
  }

  const FIELDS = ["lower", "upper", "atLeast", "shallow", "deep", "recovery"];

  function frameOf(object, row) {
    const found = { verdict: told.verdicts[object.columns[12 * count + row]] };
    FIELDS.forEach((name, at) => (found[name] = 1e3 * object.columns[at * count + row]));
    found.onObject = [6, 7, 8].map((at) => object.columns[at * count + row]);
    found.onHull = [9, 10, 11].map((at) => object.columns[at * count + row]);
    return found;
  }

  const depthText = (at) => (at.deep > 0 ? boundsText(at.shallow, at.deep) : "-");

  // What a lane says: depth counts as below 0.
  function signedText(at) {
    if (at.deep > 0) return `${boundsText(at.shallow, at.deep)} mm deep`;
    return Number.isNaN(at.upper) && Number.isNaN(at.lower) ? "" : `${boundsText(at.lower, at.upper)} mm`;
  }

  function frameText(row) {
    const reason = told.reasons[row];
    if (reason) return `frame ${told.frames[row]}, ${told.times[row].toFixed(2)} seconds: ${reason}`;
    const bad = told.objects
      .map((object) => [object.name, object.columns && frameOf(object, row)])
      .filter(([, at]) => at && at.verdict !== "kept")
      .map(([name, at]) => `${name} ${at.verdict} ${signedText(at)}`);
    const what = bad.length ? bad.join(", ") : "all keep their distance";
    return `frame ${told.frames[row]}, ${told.times[row].toFixed(2)} seconds: ${what}`;
  }

  function fillReadout(row) {
    const body = document.querySelector("#readout tbody");
    body.replaceChildren();
    told.objects.forEach((object, number) => {
      const at = object.columns ? frameOf(object, row) : null;
      const lane = document.querySelector(`[data-lane="${number}"]`);
      if (at === null) return;
      if (lane) lane.textContent = `${at.verdict} ${signedText(at)}`;
      const line = body.insertRow();
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = object.name;
      line.append(head);
      const verdict = line.insertCell();
      verdict.textContent = at.verdict;
      verdict.className = `word-${at.verdict.replace(" ", "-")}`;
      const atLeast = Number.isFinite(at.atLeast) ? `at least ${atLeastText(at.atLeast, at.lower)}` : "-";
      const recovery = Number.isFinite(at.recovery) ? at.recovery.toFixed(1) : "-";
      for (const text of [
        boundsText(at.lower, at.upper), atLeast,
        object.required_mm ? String(object.required_mm) : "-", depthText(at), recovery,
      ]) {
        const cell = line.insertCell();
        cell.className = "n";
        cell.textContent = text;
      }
    });
  }

  // --- Pictures -------------------------------------------------------------------------------

  const shots = told.cameras.map((camera, number) => ({ name: camera.name, number, list: null, image: null }));

  function makeShots() {
    const place = byId("seen");
    if (place === null) return;
    for (const shot of shots) {
      const source = byId(`pictures-${shot.number}`);
      if (source === null) continue;
      shot.list = source.textContent.split("\n");
      const figure = document.createElement("figure");
      shot.image = document.createElement("img");
      const caption = document.createElement("figcaption");
      caption.textContent = shot.name;
      figure.append(shot.image, caption);
      place.append(figure);
    }
  }

  function showShots(row) {
    const at = Math.floor(row / Math.max(told.pictures_every, 1));
    for (const shot of shots) {
      if (shot.image === null) continue;
      const text = shot.list[at];
      const frame = told.frames[at * told.pictures_every];
      shot.image.alt = text
        ? `What ${shot.name} saw at frame ${frame}, with the outline of what is real`
        : `${shot.name} has no picture of frame ${frame}`;
      if (text) shot.image.src = `data:image/webp;base64,${text}`;
      else shot.image.removeAttribute("src");
    }
  }

  // --- The scene ------------------------------------------------------------------------------

  const COLOURS = {
    free: 0x8fa8c4, touchedPart: 0xe8c3bb, hit: 0xd2101c, points: 0x5a0008, hull: 0xd9b98c,
    witness: 0x7b2fa0, camera: 0x6b7683, grid: 0x9aa0a6,
  };
  let stage = null;

  async function makeStage() {
    const canvas = byId("canvas");
    let renderer;
    try {
      renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    } catch (error) {
      byId("scene-told").textContent = "This browser draws no 3D; pictures and numbers say the same.";
      canvas.remove();
      return;
    }
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(40, 4 / 3, 0.01, 1000);
    const follower = new THREE.PerspectiveCamera(40, 4 / 3, 0.05, 1000);
    follower.matrixAutoUpdate = false;
    camera.up.fromArray(told.up);
    const controls = new THREE.OrbitControls(camera, canvas);
    scene.add(new THREE.AmbientLight(0xffffff, 1.4));
    const lamp = new THREE.DirectionalLight(0xffffff, 1.8);
    scene.add(lamp, lamp.target);
    stage = {
      renderer, scene, camera, follower, controls, lamp, canvas, followed: null, hulls: new Map(), labels: [],
      border: null, isAsked: false,
    };
    controls.addEventListener("change", draw);
    addFloor();
    addCameras();
    stage.hull = new THREE.Mesh(
      new THREE.BufferGeometry(),
      new THREE.MeshLambertMaterial({
        color: COLOURS.hull, transparent: true, opacity: 0.6, side: THREE.DoubleSide, depthWrite: false,
      }),
    );
    stage.hull.renderOrder = 2;
    scene.add(stage.hull);
    for (const object of told.objects) await addObject(object);
    viewWhole();
    const media = window.matchMedia("(prefers-color-scheme: dark)");
    const onTheme = () => {
      renderer.setClearColor(new THREE.Color(media.matches ? 0x202327 : 0xf5f6f7));
      draw();
    };
    media.addEventListener("change", onTheme);
    new ResizeObserver(draw).observe(byId("stage"));
    onTheme();
  }

  function addFloor() {
    const size = told.floor.size;
    const grid = new THREE.GridHelper(size, Math.round(size / told.floor.grid), COLOURS.grid, COLOURS.grid);
    grid.material.transparent = true;
    grid.material.opacity = 0.35;
    // The grid lies across y; its y is to be the scene's up.
    const up = new THREE.Vector3().fromArray(told.up);
    grid.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), up);
    grid.position.fromArray(told.floor.middle);
    stage.scene.add(grid);
  }

  // From the camera's frame (x right, y down, z ahead) to the page's, as three.js has cameras.
  function poseOf(camera, row) {
    const pose = camera.poses ? camera.poses[row] : camera.pose;
    if (!pose) return null;
    const [a, b, c, x, d, e, f, y, g, h, i, z] = pose;
    const px = -(a * x + d * y + g * z), py = -(b * x + e * y + h * z), pz = -(c * x + f * y + i * z);
    return new THREE.Matrix4().set(a, -d, -g, px, b, -e, -h, py, c, -f, -i, pz, 0, 0, 0, 1);
  }

  function addCameras() {
    stage.cameras = told.cameras.map((camera) => {
      const length = told.camera_m;
      const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]].map(
        ([x, y]) => [(length * (x - camera.cx)) / camera.fx, (-length * (y - camera.cy)) / camera.fy, -length],
      );
      const lines = [];
      corners.forEach((corner, at) => lines.push([0, 0, 0], corner, corner, corners[(at + 1) % 4]));
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(lines.flat()), 3));
      const drawn = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: COLOURS.camera }));
      drawn.matrixAutoUpdate = false;
      stage.scene.add(drawn);
      return { ...camera, drawn, label: addLabel(camera.name) };
    });
    const view = byId("view");
    told.cameras.forEach((camera, number) => {
      const option = document.createElement("option");
      option.value = String(number);
      option.textContent = `through ${camera.name}`;
      view.append(option);
    });
  }

  function addLabel(text) {
    const label = document.createElement("div");
    label.className = "label";
    label.textContent = text;
    label.setAttribute("aria-hidden", "true");
    byId("stage").append(label);
    const entry = { label, at: new THREE.Vector3(), isShown: true };
    stage.labels.push(entry);
    return entry;
  }

  async function addObject(object) {
    if (!object.has_mesh) return;
    const mesh = await chunk(`object-${object.number}-mesh`);
    const vertices = new Float32Array(mesh, 0, 3 * object.n_vertices);
    const faces = new Uint32Array(mesh, 12 * object.n_vertices, 3 * object.n_faces);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
    geometry.setIndex(new THREE.BufferAttribute(faces, 1));
    const corners = geometry.toNonIndexed();  // flat faces, as CAD has them
    corners.computeVertexNormals();
    geometry.computeBoundingBox();
    const group = new THREE.Group();
    group.matrixAutoUpdate = false;
    const body = new THREE.Mesh(
      corners,
      new THREE.MeshLambertMaterial({
        color: COLOURS.free, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1,
        polygonOffsetUnits: 1,
      }),
    );
    const edges = new THREE.LineSegments(
      new THREE.EdgesGeometry(geometry, 30),
      new THREE.LineBasicMaterial({ color: 0x2c3640, transparent: true, opacity: 0.35 }),
    );
    const hits = new THREE.Mesh(
      new THREE.BufferGeometry(),
      new THREE.MeshBasicMaterial({ color: COLOURS.hit, side: THREE.DoubleSide }),
    );
    // What is touched shines through what is before it, or it would be seen from one side only.
    const through = new THREE.Mesh(
      hits.geometry,
      new THREE.MeshBasicMaterial({
        color: COLOURS.hit, side: THREE.DoubleSide, transparent: true, opacity: 0.3, depthTest: false,
      }),
    );
    through.renderOrder = 3;
    group.add(body, edges, hits, through);
    const points = new THREE.Points(
      new THREE.BufferGeometry(),
      new THREE.PointsMaterial({
        color: COLOURS.points, size: 3, sizeAttenuation: false, depthTest: false,
      }),
    );
    points.renderOrder = 4;
    const witness = new THREE.LineSegments(
      new THREE.BufferGeometry(),
      new THREE.LineBasicMaterial({ color: COLOURS.witness, depthTest: false }),
    );
    const ends = new THREE.Points(
      witness.geometry,
      new THREE.PointsMaterial({ color: COLOURS.witness, size: 8, sizeAttenuation: false, depthTest: false }),
    );
    witness.renderOrder = ends.renderOrder = 3;
    stage.scene.add(group, points, witness, ends);
    const placement = await chunk(`object-${object.number}-placement`);
    const touched = await chunk(`object-${object.number}-touched`);
    const sample = await chunk(`object-${object.number}-points`);
    Object.assign(object, {
      vertices, faces, group, body, edges, hits, through, points, witness, ends,
      placement: new Float32Array(placement),
      touched: touched === null ? null : listsOf(touched),
      sample: sample === null ? null : sampleOf(sample),
      label: addLabel(object.name),
      center: geometry.boundingBox.getCenter(new THREE.Vector3()),
    });
  }

  function sampleOf(buffer) {
    const counts = new Uint32Array(buffer, 0, count);
    const places = new Float32Array(buffer, 4 * count);
    const starts = [0];
    for (let row = 0; row < count; row++) starts.push(starts[row] + counts[row]);
    return (row) => places.subarray(3 * starts[row], 3 * starts[row + 1]);
  }

  function placementOf(object, row) {
    const moves = object.placement.length > 12;
    const pose = object.placement.subarray(moves ? 12 * row : 0, moves ? 12 * row + 12 : 12);
    if (Number.isNaN(pose[0])) return null;
    return new THREE.Matrix4().set(...pose, 0, 0, 0, 1);
  }

  function setPlaces(geometry, places) {
    geometry.dispose();
    geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
    geometry.computeBoundingSphere();
  }

  function showScene(row) {
    if (stage === null) return;
    const isShown = Object.fromEntries(
      ["cad", "hull", "touched", "witness"].map((name) => [name, byId(`show-${name}`)?.checked ?? false]),
    );
    for (const object of told.objects) {
      if (!object.group) continue;
      const pose = placementOf(object, row);
      const at = frameOf(object, row);
      const list = object.touched === null ? [] : object.touched[row];
      const collides = at.verdict === "clash" || at.verdict === "inside";
      object.group.visible = pose !== null && isShown.cad;
      object.label.isShown = object.group.visible;
      object.label.label.classList.toggle("touched", collides || at.verdict === "too near");
      if (pose !== null) {
        object.group.matrix.copy(pose);
        object.label.at.copy(object.center).applyMatrix4(pose);
      }
      object.body.material.color.set(collides ? COLOURS.touchedPart : COLOURS.free);
      object.hits.visible = object.through.visible = isShown.touched && list.length > 0;
      if (object.hits.visible) {
        const places = new Float32Array(9 * list.length);
        list.forEach((triangle, k) => {
          for (let corner = 0; corner < 3; corner++) {
            const vertex = object.faces[3 * triangle + corner];
            places.set(object.vertices.subarray(3 * vertex, 3 * vertex + 3), 9 * k + 3 * corner);
          }
        });
        setPlaces(object.hits.geometry, places);
      }
      const sample = object.sample === null ? new Float32Array(0) : object.sample(row);
      object.points.visible = isShown.touched && sample.length > 0;
      if (object.points.visible) setPlaces(object.points.geometry, sample.slice());
      const pair = [...at.onObject, ...at.onHull];
      const isMeasured = pair.every(Number.isFinite);
      object.witness.visible = object.ends.visible = isShown.witness && isMeasured;
      if (isMeasured) setPlaces(object.witness.geometry, new Float32Array(pair));
    }
    for (const camera of stage.cameras) {
      const pose = poseOf(camera, row);
      camera.drawn.visible = pose !== null;
      if (pose !== null) {
        camera.drawn.matrix.copy(pose);
        camera.label.at.setFromMatrixPosition(pose);
      }
      camera.label.isShown = pose !== null && stage.followed === null;
    }
    showHull(row, isShown.hull);
    follow(row);
    draw();
  }

  async function showHull(row, isShown) {
    const at = told.hull_every ? told.hull_every * Math.floor(row / told.hull_every) : -1;
    stage.hull.visible = isShown && at >= 0;
    byId("scene-told").textContent = told.hull_every > 1 ? `hull of frame ${told.frames[at]}` : "";
    if (!stage.hull.visible || stage.hullAt === at) return;
    const buffer = await chunk(`hull-${at}`);
    if (state.row < 0 || Math.floor(state.row / told.hull_every) * told.hull_every !== at) return;  // scrubbed on
    stage.hullAt = at;
    stage.hull.geometry.dispose();
    const geometry = new THREE.BufferGeometry();
    if (buffer !== null) {
      const [n, t] = new Int32Array(buffer, 0, 2);
      const corner = new Float32Array(buffer, 8, 3);
      const steps = new Int16Array(buffer, 20, 3 * n);
      const places = new Float32Array(3 * n);
      for (let axis = 0; axis < 3; axis++) {
        let value = 0;
        for (let k = 0; k < n; k++) {
          value += steps[axis * n + k];
          places[3 * k + axis] = corner[axis] + told.hull_step_m * value;
        }
      }
      const turns = new Int32Array(buffer.slice(20 + 6 * n));
      const faces = new Uint32Array(3 * t);
      let vertex = 0;
      for (let k = 0; k < faces.length; k++) faces[k] = vertex += turns[k];
      geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
      geometry.setIndex(new THREE.BufferAttribute(faces, 1));
      geometry.computeVertexNormals();
    }
    stage.hull.geometry = geometry;
    draw();
  }

  // Looks through a recorded camera: its picture's border fits into the stage.
  function follow(row) {
    const { canvas, follower } = stage;
    stage.border?.remove();
    stage.border = null;
    const camera = stage.followed === null ? null : stage.cameras[stage.followed];
    const pose = camera === null ? null : poseOf(camera, row);
    stage.controls.enabled = pose === null;
    stage.active = pose === null ? stage.camera : follower;
    if (pose === null) return;
    follower.matrix.copy(pose);
    follower.matrixWorld.copy(pose);
    follower.matrixWorldInverse.copy(pose).invert();
    const near = follower.near, far = follower.far;
    let left = -camera.cx / camera.fx, right = (camera.width - camera.cx) / camera.fx;
    let top = camera.cy / camera.fy, bottom = -(camera.height - camera.cy) / camera.fy;
    const inner = { left, right, top, bottom };
    const aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
    const wide = right - left, high = top - bottom;
    const addX = Math.max(0, aspect * high - wide) / 2, addY = Math.max(0, wide / aspect - high) / 2;
    left -= addX; right += addX; top += addY; bottom -= addY;
    follower.projectionMatrix.makePerspective(left * near, right * near, top * near, bottom * near, near, far);
    follower.projectionMatrixInverse.copy(follower.projectionMatrix).invert();
    const border = document.createElement("div");
    border.className = "border";
    const share = (value, low, high) => `${(100 * (value - low)) / (high - low)}%`;
    border.style.left = share(inner.left, left, right);
    border.style.right = share(-inner.right, -right, -left);
    border.style.top = share(-inner.top, -top, -bottom);
    border.style.bottom = share(inner.bottom, bottom, top);
    byId("stage").append(border);
    stage.border = border;
  }

  function lookAt(target, distance, from) {
    const { camera, controls } = stage;
    controls.target.fromArray(target);
    camera.position.fromArray(target).addScaledVector(new THREE.Vector3().fromArray(from), distance);
    camera.near = distance / 500;
    camera.far = distance * 50;
    camera.updateProjectionMatrix();
    controls.update();
  }

  const viewWhole = () => lookAt(told.target, told.distance, told.from);

  function draw() {
    if (stage === null || stage.isAsked) return;
    stage.isAsked = true;
    requestAnimationFrame(() => {
      stage.isAsked = false;
      const { renderer, camera, canvas, scene, lamp } = stage;
      const box = byId("stage").getBoundingClientRect();
      const width = Math.max(1, Math.round(box.width)), height = Math.max(1, Math.round(box.height));
      renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      const eye = stage.active ?? camera;
      lamp.position.setFromMatrixPosition(eye.matrixWorld);
      lamp.target.position.copy(stage.controls.target);
      renderer.render(scene, eye);
      const taken = [];
      for (const { label, at, isShown } of stage.labels) {
        const place = at.clone().project(eye);
        const x = (0.5 + 0.5 * place.x) * canvas.clientWidth;
        const y = (0.5 - 0.5 * place.y) * canvas.clientHeight;
        const isIn = isShown && Math.abs(place.x) < 1 && Math.abs(place.y) < 1 && place.z < 1;
        // Of labels that would lie on each other the first stays.
        const isFree = isIn && !taken.some(([u, v]) => Math.abs(u - x) < 60 && Math.abs(v - y) < 16);
        label.style.display = isFree ? "" : "none";
        if (isFree) {
          taken.push([x, y]);
          label.style.left = `${50 + 50 * place.x}%`;  // in print the stage is of another size
          label.style.top = `${50 - 50 * place.y}%`;
        }
      }
    });
  }

  function onStageKey(event) {
    if (stage === null || stage.followed !== null) return;
    const offset = stage.camera.position.clone().sub(stage.controls.target);
    const up = stage.camera.up;
    const turn = 0.12;
    const side = new THREE.Vector3().crossVectors(up, offset).normalize();
    if (event.key === "ArrowLeft") offset.applyAxisAngle(up, -turn);
    else if (event.key === "ArrowRight") offset.applyAxisAngle(up, turn);
    else if (event.key === "ArrowUp" || event.key === "ArrowDown") {
      const turned = offset.clone().applyAxisAngle(side, event.key === "ArrowUp" ? -turn : turn);
      if (Math.abs(turned.clone().normalize().dot(up)) < 0.99) offset.copy(turned);
    } else if (event.key === "+" || event.key === "=") offset.multiplyScalar(0.85);
    else if (event.key === "-") offset.multiplyScalar(1 / 0.85);
    else return;
    event.preventDefault();
    stage.camera.position.copy(stage.controls.target).add(offset);
    stage.controls.update();
    draw();
  }

  // --- Scrubbing ------------------------------------------------------------------------------

  const scrubber = byId("scrubber"), cursor = byId("cursor"), lanes = byId("lanes");
  const span = count > 1 ? told.times[count - 1] - told.times[0] : 0;
  const shareOf = (row) => (span > 0 ? (told.times[row] - told.times[0]) / span : 0);

  function show(wanted) {
    const row = Math.min(Math.max(wanted, 0), count - 1);
    if (row === state.row) return;
    state.row = row;
    scrubber.value = String(row);
    const reason = told.reasons[row] ? ` (${told.reasons[row]})` : "";
    byId("now").textContent = `frame ${told.frames[row]}, ${told.times[row].toFixed(2)} s${reason}`;
    cursor.style.left = `${100 * shareOf(row)}%`;
    scrubber.setAttribute("aria-valuetext", frameText(row));
    fillReadout(row);
    showShots(row);
    showScene(row);
  }

  function rowAt(share) {
    const time = told.times[0] + share * span;
    let best = 0;
    for (let row = 1; row < count; row++) {
      if (Math.abs(told.times[row] - time) < Math.abs(told.times[best] - time)) best = row;
    }
    return best;
  }

  function onPointer(event) {
    if (event.type === "pointerdown") lanes.setPointerCapture(event.pointerId);
    else if (!event.buttons) return;
    const box = lanes.getBoundingClientRect();
    show(rowAt(Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1)));
  }

  function onScrubKey(event) {
    const steps = { PageUp: 10, PageDown: -10 };
    if (!(event.key in steps)) return;  // a slider has the others by itself
    event.preventDefault();
    show(state.row + steps[event.key]);
  }

  const play = byId("play");
  let playing = 0;
  function step(started, from) {
    playing = requestAnimationFrame(() => {
      const time = told.times[from] + (performance.now() - started) / 1000;
      let row = from;
      while (row + 1 < count && told.times[row + 1] <= time) row++;
      show(row);
      if (row + 1 < count) step(started, from);
      else stop();
    });
  }
  function stop() {
    cancelAnimationFrame(playing);
    playing = 0;
    play.setAttribute("aria-pressed", "false");
    play.textContent = "Play";
  }
  function onPlay() {
    if (playing) return stop();
    play.setAttribute("aria-pressed", "true");
    play.textContent = "Stop";
    step(performance.now(), state.row + 1 < count ? state.row : 0);
  }

  function onClash(event) {
    const clash = told.clashes[Number(event.currentTarget.dataset.clash)];
    byId("view").value = "";
    if (stage !== null) {
      stage.followed = null;
      lookAt(clash.place, clash.distance, told.from);
    }
    state.row = -1;
    show(clash.row);
    byId("frames-title").scrollIntoView({ block: "start" });
    scrubber.focus({ preventScroll: true });
  }

  async function begin() {
    for (const object of told.objects) {
      const buffer = await chunk(`object-${object.number}-frames`);
      object.columns = buffer === null ? null : new Float32Array(buffer);
    }
    makeShots();
    await makeStage();
    scrubber.addEventListener("input", () => show(Number(scrubber.value)));
    scrubber.addEventListener("keydown", onScrubKey);
    for (const name of ["pointerdown", "pointermove"]) lanes.addEventListener(name, onPointer);
    play.addEventListener("click", onPlay);
    byId("stage").addEventListener("keydown", onStageKey);
    document.querySelectorAll("[data-clash]").forEach((one) => one.addEventListener("click", onClash));
    for (const name of ["cad", "hull", "touched", "witness"]) {
      byId(`show-${name}`)?.addEventListener("change", () => showScene(state.row));
    }
    byId("whole").addEventListener("click", () => {
      byId("view").value = "";
      if (stage === null) return;
      stage.followed = null;
      viewWhole();
      showScene(state.row);
    });
    byId("view").addEventListener("change", () => {
      if (stage === null) return;
      stage.followed = byId("view").value === "" ? null : Number(byId("view").value);
      showScene(state.row);
    });
    show(told.first);
    document.documentElement.dataset.ready = "yes";
  }

  // The answer is seen before the scene is made.
  requestAnimationFrame(() => setTimeout(begin, 0));
})();
