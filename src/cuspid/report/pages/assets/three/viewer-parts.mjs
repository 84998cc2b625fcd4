// What the viewer uses of three.js.
export { BufferAttribute, BufferGeometry, DirectionalLight, DoubleSide, HemisphereLight, Line, LineBasicMaterial, LineSegments, Mesh, MeshLambertMaterial, OrthographicCamera, Points, PointsMaterial, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from "three";
export { TrackballControls } from "three/addons/controls/TrackballControls.js";
